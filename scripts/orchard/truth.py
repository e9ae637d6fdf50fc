"""What is true about every fruit: where it is, how large, and how much of it each view shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .cameras import Viewpoint
from .fruiting import PlacedFruit
from .meshes import Mesh

FloatArray = NDArray[np.float64]

LEAST_VIEWS, LEAST_FRACTION, LEAST_PIXELS = 3, 0.10, 12
"""A fruit is visible when so many views show at least this share and this number of its pixels."""


@dataclass(frozen=True, kw_only=True)
class Visibility:
    """How V views show one fruit."""

    visible_pixels: tuple[int, ...]
    """Pixels of the fruit seen in each view."""
    whole_pixels: tuple[int, ...]
    """Pixels it would cover in each view with nothing in front of it."""

    @property
    def fractions(self) -> FloatArray:
        """(V,) seen ÷ whole; 0 where the fruit lies outside the picture."""
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
        shown = (self.fractions >= LEAST_FRACTION) & (np.array(self.visible_pixels) >= LEAST_PIXELS)
        return int(shown.sum()) >= LEAST_VIEWS


def silhouette_pixels(view: Viewpoint, mesh: Mesh) -> int:
    """How many pixel centres inside the picture the mesh covers, with nothing in front of it.

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
    a, b, c = a[area > 0], b[area > 0], c[area > 0]
    covered = np.zeros((high[1] - low[1], high[0] - low[0]), dtype=bool)
    for p, q, r in zip(a, b, c, strict=True):
        x0, y0 = np.maximum(np.floor(np.minimum(np.minimum(p, q), r) - 0.5).astype(int), low)
        x1, y1 = np.minimum(np.ceil(np.maximum(np.maximum(p, q), r) + 0.5).astype(int), high)
        if x1 <= x0 or y1 <= y0:
            continue
        x, y = np.arange(x0, x1) + 0.5, (np.arange(y0, y1) + 0.5)[:, None]
        inside = (q[0] - p[0]) * (y - p[1]) >= (q[1] - p[1]) * (x - p[0])
        inside &= (r[0] - q[0]) * (y - q[1]) >= (r[1] - q[1]) * (x - q[0])
        inside &= (p[0] - r[0]) * (y - r[1]) >= (p[1] - r[1]) * (x - r[0])
        covered[y0 - low[1] : y1 - low[1], x0 - low[0] : x1 - low[0]] |= inside
    return int(covered.sum())


def visibilities(
    views: Sequence[Viewpoint], instances: Sequence[NDArray[np.uint16]], ids: Sequence[int], meshes: Sequence[Mesh]
) -> list[Visibility]:
    """How the views show each fruit, from their instance masks (H, W) and the fruits' meshes."""
    top = max(ids, default=0) + 1
    seen = np.array([np.bincount(mask.ravel(), minlength=top)[:top] for mask in instances])
    return [
        Visibility(
            visible_pixels=tuple(int(n) for n in seen[:, number]),
            whole_pixels=tuple(silhouette_pixels(view, mesh) for view in views),
        )
        for number, mesh in zip(ids, meshes, strict=True)
    ]


def fruit_record(fruit: PlacedFruit, label: str, visibility: Visibility, names: Sequence[str]) -> dict[str, object]:
    """One entry of truth.json; the centre is the volume's centroid, in the COLMAP model's frame."""
    pixels = {name: n for name, n in zip(names, visibility.visible_pixels, strict=True) if n > 0}
    return {
        "id": fruit.id,
        "label": label,
        "center": [round(float(c), 6) for c in fruit.body.center],
        "diameter": round(float(fruit.diameter), 6),
        "kind": fruit.kind,
        "clump": fruit.clump,
        "visible_pixels": pixels,
        "visible_fraction": round(visibility.visible_fraction, 4),
        "visible": visibility.visible,
    }
