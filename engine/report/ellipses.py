"""Fruit in a picture: the ellipse of each ellipsoid in a camera, and the unobstructed share of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..counting.evidence.visibility import draw, gather_view_evidence
from ..counting.fruit import Fruit
from ..scene.camera import Camera
from ..splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]

HIDDEN_BELOW = 0.1
"""Unobstructed share below which a fruit counts as hidden in this picture."""


@dataclass(frozen=True, eq=False)
class Ellipse:
    """The outline of a fruit in a picture.

    center: (2,) px; axes: (2, 2) rows are its half axes, px, longest first; depth: of the fruit's centre, scene units;
    visible: unobstructed share, in [0, 1].
    """

    id: int
    center: FloatArray
    axes: FloatArray
    depth: float
    visible: float

    @property
    def hidden(self) -> bool:
        return self.visible < HIDDEN_BELOW

    @property
    def reach(self) -> FloatArray:
        """(2,) px from the centre to the sides of its upright box."""
        return np.linalg.norm(self.axes, axis=0)

    def outline(self, corners: int) -> FloatArray:
        """See `outline_points`."""
        return outline_points(self.center, self.axes, corners)


def outline_points(center: FloatArray, axes: FloatArray, corners: int) -> FloatArray:
    """(corners, 2) px along an ellipse with center (2,) and half axes (2, 2)."""
    turns = 2.0 * np.pi * np.arange(corners) / corners
    return center + np.stack([np.cos(turns), np.sin(turns)], axis=1) @ axes


def ellipses(gaussians: Gaussians, fruits: Sequence[Fruit], camera: Camera) -> list[Ellipse]:
    """The outlines of the fruit whose centres lie in the camera's picture, nearest first."""
    found = [
        (fruit, shape) for fruit in fruits if (shape := project_ellipsoid(fruit.center, fruit.axes, camera)) is not None
    ]
    if not found:
        return []
    shares = measure_visibility(gaussians, [fruit for fruit, _ in found], camera)
    outlines = [
        Ellipse(fruit.id, center, axes, float(camera.project(fruit.center)[1]), float(share))
        for (fruit, (center, axes)), share in zip(found, shares, strict=True)
    ]
    return sorted(outlines, key=lambda outline: (outline.depth, outline.id))


def measure_visibility(gaussians: Gaussians, fruits: Sequence[Fruit], camera: Camera) -> FloatArray:
    """Measure the unobstructed share (F,) of each fruit in the camera; 0 if half of it is outside the picture."""
    view_evidence = gather_view_evidence(
        draw(gaussians, np.zeros(len(gaussians)), [camera]),
        np.array([fruit.center for fruit in fruits], np.float64).reshape(-1, 3),
        np.array([fruit.diameter / 2.0 for fruit in fruits], np.float64),
        threshold=0.0,  # Objects on the surface of a fruit count as the fruit: only depths distinguish them.
    )
    return np.nan_to_num(view_evidence.visible_fractions)


def project_ellipsoid(center: FloatArray, axes: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray] | None:
    """Project an ellipsoid: (2,) centre and (2, 2) half axes, px, of its outline.

    axes: (3, 3), rows are its half axes in scene units.

    None if its centre is not in the picture or a part of it is not in front of the camera. The outline is the dual
    conic K (Σ - c cᵀ) Kᵀ of Σ = AᵀA and the centre c in the camera's frame (Hartley and Zisserman 2004, 8.7).
    """
    place, depth = camera.project(center)
    if not depth > 0.0 or not (0.0 <= place[0] < camera.width and 0.0 <= place[1] < camera.height):
        return None
    rotation = camera.world_to_camera[:3, :3]
    middle = rotation @ center + camera.world_to_camera[:3, 3]
    turned = axes @ rotation.T
    conic = camera.K @ (turned.T @ turned - np.outer(middle, middle)) @ camera.K.T
    if conic[2, 2] >= 0.0:
        return None
    conic = conic / conic[2, 2]
    spread = np.outer(conic[:2, 2], conic[:2, 2]) - conic[:2, :2]
    variances, directions = np.linalg.eigh(spread)
    half = np.sqrt(np.maximum(variances, 0.0))[::-1, None] * directions.T[::-1]
    return conic[:2, 2], half
