"""The ground truth of every fruit: position, size, and how much of it each view shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cameras.viewpoint import Viewpoint
from ..plants.crop import PlacedFruit
from ..shapes.meshes import Mesh

FloatArray = NDArray[np.float64]

LEAST_VIEWS, LEAST_FRACTION, LEAST_PIXELS = 3, 0.10, 12
"""A fruit is visible if this many views show at least this share and this number of its pixels."""

AT_ONCE = 1_000_000
"""Pairs of triangle and pixel tested at once."""


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """The visibility of one fruit in V views."""

    visible_pixels: tuple[int, ...]
    """Visible pixels of the fruit in each view."""
    whole_pixels: tuple[int, ...]
    """Pixels of the fruit in each view without occlusion; 0 if none is visible."""

    @property
    def fractions(self) -> FloatArray:
        """(V,) visible ÷ whole; 0 if nothing of the fruit is visible."""
        seen = np.array(self.visible_pixels, dtype=np.float64)
        whole = np.array(self.whole_pixels, dtype=np.float64)
        return np.where(whole > 0, np.minimum(seen / np.maximum(whole, 1.0), 1.0), 0.0)

    @property
    def visible_fraction(self) -> float:
        """The largest fraction over the views."""
        return float(self.fractions.max(initial=0.0))

    @property
    def visible(self) -> bool:
        """Whether enough views show enough of it."""
        return is_visible(self.visible_pixels, self.fractions)


def is_visible(pixels: ArrayLike, fractions: ArrayLike) -> bool:
    """Whether enough views show enough of a fruit, by its visible pixels (V,) and what share these are (V,)."""
    shown = (np.asarray(fractions) >= LEAST_FRACTION) & (np.asarray(pixels) >= LEAST_PIXELS)
    return int(shown.sum()) >= LEAST_VIEWS


def count_silhouette_pixels(view: Viewpoint, mesh: Mesh) -> int:
    """Count the pixel centres inside the picture that the mesh covers, with nothing in front of it.

    Every triangle is tested against every pixel centre of the mesh's bounding box, so the outline is the mesh's own.
    """
    pixels, depths = view.project(mesh.vertices)
    if depths.min() <= 0.0:
        return 0
    low = np.maximum(np.floor(pixels.min(axis=0)), 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)), [view.width, view.height]).astype(int)
    if (high <= low).any():
        return 0
    corners = pixels[mesh.triangles]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area: FloatArray = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    # A closed surface is covered twice: the half that turns one way is enough.
    front = corners[area > 0]
    grid = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    centers = np.stack([each.ravel() for each in grid], axis=1)
    covered = np.zeros(len(centers), dtype=bool)
    block = max(1, AT_ONCE // len(centers))
    for start in range(0, len(front), block):
        covered |= _find_inside(front[start : start + block], centers).any(axis=0)
    return int(covered.sum())


def _find_inside(triangles: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """Find (T, P) whether the (T, 3, 2) triangles hold the (P, 2) points."""
    inside = np.ones((len(triangles), len(points)), dtype=bool)
    for corner in range(3):
        p, q = triangles[:, corner, None], triangles[:, (corner + 1) % 3, None]
        dx, dy = q[..., 0] - p[..., 0], q[..., 1] - p[..., 1]
        inside &= dx * (points[:, 1] - p[..., 1]) >= dy * (points[:, 0] - p[..., 0])
    return inside


def measure_visibilities(
    views: Sequence[Viewpoint], instances: Sequence[NDArray[np.uint16]], ids: Sequence[int], meshes: Sequence[Mesh]
) -> list[Visibility]:
    """Measure the visibility of each fruit, from instance masks (H, W) and the meshes of the fruit."""
    top = max(ids, default=0) + 1
    seen = np.array([np.bincount(mask.ravel(), minlength=top)[:top] for mask in instances])
    return [
        Visibility(
            visible_pixels=tuple(int(n) for n in seen[:, number]),
            whole_pixels=tuple(
                count_silhouette_pixels(view, mesh) if n else 0 for view, n in zip(views, seen[:, number], strict=True)
            ),
        )
        for number, mesh in zip(ids, meshes, strict=True)
    ]


def fruit_record(fruit: PlacedFruit, label: str, visibility: Visibility, names: Sequence[str]) -> dict[str, object]:
    """One entry of truth.json; the centre is the centroid of the volume, in the frame of the COLMAP model.

    A neighbour's fruit is never visible: it belongs to no count, and a prediction on it is no error.
    """
    shown = [i for i, n in enumerate(visibility.visible_pixels) if n > 0]
    return {
        "id": fruit.id,
        "label": label,
        "center": [round(float(c), 6) for c in fruit.body.center],
        "diameter": round(float(fruit.diameter), 6),
        "kind": fruit.kind,
        "tree": fruit.tree,
        "clump": fruit.clump,
        "visible_pixels": {names[i]: visibility.visible_pixels[i] for i in shown},
        "visible_fractions": {names[i]: round(float(visibility.fractions[i]), 4) for i in shown},
        "visible_fraction": round(visibility.visible_fraction, 4),
        "visible": visibility.visible and fruit.kind != "neighbour",
    }


def view_record(view: Viewpoint) -> dict[str, object]:
    """One picture's true camera: a pinhole whose principal point is the picture's middle, focal length in pixels."""
    return {
        "name": view.name,
        "focal": float(view.focal),
        "width": view.width,
        "height": view.height,
        "world_to_camera": view.world_to_camera.tolist(),
    }
