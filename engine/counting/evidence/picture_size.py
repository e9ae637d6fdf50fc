"""The fruit diameter estimated from rendered views: widths of the regions that match the prompt, times their depth.

Blurred Gaussians have no surface that a sphere fits, but they still draw regions as wide as the fruit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...splatting.kernels.surface import NOTHING
from .pixel_width import focal_length
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
    """R connected regions of pixels that match the prompt.

    pixels, widths: (R,) diameter of the largest inscribed circle, in pixels and in scene units; areas: (R,) pixels;
    single: (R,) whether it may be one fruit: round, wide enough, and not cut by the border of the view.
    """

    pixels: FloatArray
    widths: FloatArray
    areas: FloatArray
    single: NDArray[np.bool_]


def size_from_pictures(pictures: Sequence[Picture], threshold: float, contains: Contains) -> FruitSize | None:
    """The most common width of the round regions whose blended probability reaches `threshold`; None if there are few.

    Wide regions weigh more, because a pixel is a smaller part of them. contains: which positions (M, 3) belong to the
    part of the scene that is counted.
    """
    found = [regions_of(picture, threshold, contains) for picture in pictures]
    pixels, widths, areas, single = (
        np.concatenate([getattr(each, field.name) for each in found]) for field in fields(Regions)
    )
    if single.sum() < FEWEST_REGIONS or areas[single].sum() < LEAST_SHARE * areas.sum():
        return None
    logs = np.log(widths[single])
    places = np.arange(logs.min(), logs.max() + 0.02, 0.02)
    density = (pixels[single] * np.exp(-0.5 * ((places[:, None] - logs) / BANDWIDTH) ** 2)).sum(axis=1)
    return FruitSize(float(np.exp(places[int(density.argmax())])), SPREAD)


def regions_of(picture: Picture, threshold: float, contains: Contains) -> Regions:
    """The regions of a view that lie in the part of the scene that is counted."""
    shown = (picture.fruit >= threshold) & (picture.depth < NOTHING)
    labels, count = ndimage.label(shown)
    if count == 0:
        return Regions(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, bool))
    distances = ndimage.distance_transform_edt(shown)
    numbers = np.arange(1, count + 1)
    row, column = np.array(ndimage.maximum_position(distances, labels, numbers)).T
    radii = distances[row, column]  # to the centre of the nearest pixel outside
    areas = np.bincount(labels.reshape(-1), minlength=count + 1)[1:].astype(np.float64)
    cut = np.isin(numbers, np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    single = (2.0 * radii >= NARROWEST) & (np.pi * (radii - 0.5) ** 2 >= LEAST_ROUND * areas) & ~cut
    depths, camera = picture.depth[row, column].astype(np.float64), picture.camera
    rays = np.stack([column + 0.5, row + 0.5, np.ones(count)], axis=1) @ np.linalg.inv(camera.K).T
    inside = contains((rays * depths[:, None]) @ camera.world_to_camera[:3, :3] + camera.center)
    widths = 2.0 * radii * depths / focal_length(camera)
    return Regions(2.0 * radii[inside], widths[inside], areas[inside], single[inside])
