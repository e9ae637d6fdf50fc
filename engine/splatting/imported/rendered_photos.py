"""Renders of Gaussians that replace photos if a reconstruction has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ...scene.camera import Camera, FloatArray, Scene
from ..gaussians import Gaussians
from ..rendering.rasterize import render
from ..subject.ground import up_from_ground
from ..subject.viewpoints import cameras_around, find_subject

BACKGROUND = (0.75, 0.82, 0.9)
"""sRGB of a pale sky, which the encoder knows, as the background of a reconstruction."""


@dataclass(frozen=True, eq=False)
class RenderedPhoto:
    """A photo that is rendered each time it is loaded."""

    name: str
    gaussians: Gaussians
    camera: Camera

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB."""
        with torch.no_grad():
            color = render(self.gaussians, self.camera, background=torch.tensor(BACKGROUND)).color
        return (color.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()

    def mask(self) -> None:
        """Every pixel may be used."""


def render_photos(gaussians: Gaussians, cameras: Sequence[Camera]) -> list[RenderedPhoto]:
    """One picture per camera, named by their order."""
    return [RenderedPhoto(f"drawn_{index + 1:03d}.png", gaussians, camera) for index, camera in enumerate(cameras)]


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """A scene whose photos are renders. up_is_known: up was given, or was estimated from the ground."""

    scene: Scene
    up_is_known: bool


def scene_around(gaussians: Gaussians, up: Sequence[float] | None, guess: FloatArray) -> RenderedScene:
    """Cameras around the most detailed part of the Gaussians, with renders.

    up: (3,) away from the ground; estimated from the ground if not given, else `guess`.
    """
    subject = find_subject(gaussians)
    found = up_from_ground(gaussians, subject) if up is None else np.asarray(up, np.float64)
    upright = guess if found is None else found / np.linalg.norm(found)
    cameras = cameras_around(subject, upright)
    scene = Scene(
        cameras=cameras,
        images=render_photos(gaussians, cameras),
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        up=upright,
    )
    return RenderedScene(scene, found is not None)
