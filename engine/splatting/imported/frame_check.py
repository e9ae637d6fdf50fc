"""Checks whether a reconstruction and the cameras of photos share one frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...scene.camera import Scene
from ..gaussians import Gaussians
from ..rendering.rasterize import render

VIEWS = 8
SOLID = 0.5
"""Opacity from which a pixel shows the reconstruction."""


@dataclass(frozen=True, eq=False)
class Fit:
    """How a reconstruction matches the photos of cameras.

    covered: share of the pictures that shows it; own, other: mean correlation of its brightness, there, with the photo
    of the same camera and with that of another camera; NaN if almost nothing is covered.
    """

    covered: float
    own: float
    other: float


def measure_fit(gaussians: Gaussians, scene: Scene) -> Fit:
    """Render the reconstruction from up to VIEWS cameras and compare it with their photos.

    Raises:
        SceneError: a photo cannot be read.
    """
    views = np.unique(np.linspace(0, len(scene.cameras) - 1, VIEWS).round().astype(int))
    photos = [scene.images[view].pixels() for view in views]
    covered, own, other = [], [], []
    for index, view in enumerate(views):
        with torch.no_grad():
            drawn = render(gaussians, scene.cameras[view])
        shown = (drawn.alpha > SOLID).numpy()
        covered.append(shown.mean())
        brightness = drawn.color.numpy().mean(axis=2)
        own.append(_correlation(brightness, photos[index], shown))
        others = [photo for at, photo in enumerate(photos) if at != index and photo.shape[:2] == shown.shape]
        other += [_correlation(brightness, photo, shown) for photo in others]
    return Fit(float(np.mean(covered)), _mean(own), _mean(other))


def _correlation(brightness: NDArray[np.float32], photo: NDArray[np.uint8], shown: NDArray[np.bool_]) -> float:
    """Pearson's correlation, over the pixels `shown`; NaN if either is constant there."""
    if shown.sum() < 100:
        return float("nan")
    a, b = brightness[shown].astype(np.float64), photo.mean(axis=2)[shown]
    a, b = a - a.mean(), b - b.mean()
    spread = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / spread if spread > 0.0 else float("nan")


def _mean(values: list[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else float("nan")
