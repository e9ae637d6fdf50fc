"""The fruit diameter estimated from rendered views: widths of the regions that match the prompt, times their depth.

Blurred Gaussians have no surface that a sphere fits, but they still draw regions as wide as the fruit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...splatting.kernels.surface import NOTHING
from .size import FruitSize
from .visibility import Picture

FloatArray = NDArray[np.float64]
Contains = Callable[[FloatArray], NDArray[np.bool_]]

LEAST_ROUND = 0.4
"""Share of a region that its largest inscribed circle covers, from which the region may be one fruit. A circle has 1,
two that touch have a half; clumps, branches and crowns have less."""
NARROWEST = 3.0
"""Width in pixels below which a region is noise."""
FEWEST_REGIONS = 5
"""Number of regions, over all views, that give a size."""
LEAST_SHARE = 0.15
"""Share of the matching pixels in regions that may be one fruit, below which they show no fruit. On the sample orchard,
well trained and blurred: apples .44 and .35, leaves .015 and .045, branches, grass and sky at most .012."""
BANDWIDTH = 0.15
"""Deviation of log width within which regions count as equally wide."""
SPREAD = 0.35
"""Standard deviation of log diameter between fruit: partly hidden fruit are narrower, blurred ones wider."""


@dataclass(frozen=True, eq=False)
class Regions:
    """R connected regions of pixels.

    rows, columns: (R,) centre of the largest circle inside; widths: (R,) its diameter, and areas: (R,), in widths of a
    pixel;
    single: (R,) whether the region may be one fruit: round, wide enough, and not cut by the border of the view.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    widths: FloatArray
    areas: FloatArray
    single: NDArray[np.bool_]

    @classmethod
    def of(cls, shown: NDArray[np.bool_], aspect: float = 1.0) -> Regions:
        """The regions of the pixels (H, W) that are True; aspect: height of a pixel over its width."""
        labels, count = ndimage.label(shown)
        numbers = np.arange(1, count + 1)
        distances = ndimage.distance_transform_edt(shown, sampling=(aspect, 1.0))
        centers = np.array(ndimage.maximum_position(distances, labels, numbers), np.int64).reshape(-1, 2)
        rows, columns = centers.T
        radii = distances[rows, columns]  # to the centre of the nearest pixel outside
        areas = aspect * np.bincount(labels.reshape(-1), minlength=count + 1)[1:].astype(np.float64)
        cut = np.isin(numbers, np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
        single = (2.0 * radii >= NARROWEST) & (np.pi * (radii - 0.5) ** 2 >= LEAST_ROUND * areas) & ~cut
        return cls(rows, columns, 2.0 * radii, areas, single)


def size_from_pictures(pictures: Sequence[Picture], threshold: float, contains: Contains) -> FruitSize | None:
    """The most common width of the round regions whose blended probability reaches `threshold`; None if there are few.

    contains: which positions (M, 3) belong to the part of the scene that is counted.
    """
    found = []
    for picture in pictures:
        camera = picture.camera
        fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
        regions = Regions.of((picture.fruit >= threshold) & (picture.depth < NOTHING), fx / fy)
        depths = picture.depth[regions.rows, regions.columns].astype(np.float64)
        pixels = np.stack([regions.columns + 0.5, regions.rows + 0.5, np.ones(len(depths))], axis=1)
        rays = pixels @ np.linalg.inv(camera.K).T * depths[:, None]
        inside = contains(rays @ camera.world_to_camera[:3, :3] + camera.center)
        scales = depths / fx
        found.append((regions.widths[inside], scales[inside], regions.areas[inside], regions.single[inside]))
    width = common_width(*map(np.concatenate, zip(*found, strict=True)))
    return None if width is None else FruitSize(width, SPREAD)


def common_width(pixels: FloatArray, scales: FloatArray, areas: FloatArray, single: NDArray[np.bool_]) -> float | None:
    """The most common width of regions that may be one fruit; None if there are few, or if most of the area is in other
    regions.

    Wide regions weigh more, because a pixel is a smaller part of them. pixels, areas: (R,) of the regions; scales: (R,)
    length of a pixel; single: (R,) whether a region may be one fruit.
    """
    if single.sum() < FEWEST_REGIONS or areas[single].sum() < LEAST_SHARE * areas.sum():
        return None
    logs = np.log(pixels[single] * scales[single])
    places = np.arange(logs.min(), logs.max() + 0.02, 0.02)
    density = (pixels[single] * np.exp(-0.5 * ((places[:, None] - logs) / BANDWIDTH) ** 2)).sum(axis=1)
    return float(np.exp(places[int(density.argmax())]))
