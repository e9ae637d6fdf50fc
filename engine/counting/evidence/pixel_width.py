"""How many pixels wide fruit are in the photos."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...scene.camera import Camera
from .visibility import Picture

FloatArray = NDArray[np.float64]

IN_FRONT = 0.75
"""Diameters in front of the centre of a fruit from which a surface hides it."""


def pixel_widths(
    centers: FloatArray, diameters: FloatArray, cameras: Sequence[Camera], pictures: Sequence[Picture]
) -> FloatArray:
    """(F,) width of each fruit in pixels of the cameras: diameter · focal length / depth, the median over the views
    that show its centre, or that would if no object were in front; NaN if no view frames it.

    centers: (F, 3) and diameters: (F,) in scene units; pictures: the views rendered for these cameras, of any size.
    """
    widths = np.full((len(cameras), len(centers)), np.nan)
    shown = np.zeros(widths.shape, bool)
    for view, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        pixels, depths = picture.camera.project(centers)
        sizes = picture.camera.width, picture.camera.height
        framed = np.flatnonzero((depths > diameters) & ((pixels >= 0.0) & (pixels < sizes)).all(axis=1))
        widths[view, framed] = diameters[framed] * focal_length(camera) / depths[framed]
        column, row = pixels[framed].astype(np.int64).T
        shown[view, framed] = picture.depth[row, column] > depths[framed] - IN_FRONT * diameters[framed]
    return np.array([_median(widths[shown[:, fruit] | ~shown[:, fruit].any(), fruit]) for fruit in range(len(centers))])


def focal_length(camera: Camera) -> float:
    """The mean focal length of a camera, in pixels."""
    return 0.5 * float(camera.K[0, 0] + camera.K[1, 1])


def _median(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")
