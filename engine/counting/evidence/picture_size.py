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
from .pixel_width import focal_length
from .size import FruitSize
from .visibility import Picture

FloatArray = NDArray[np.float64]
Contains = Callable[[FloatArray], NDArray[np.bool_]]

LEAST_ROUND = 0.4
"""Share of a region that its largest inscribed circle covers, from which the region may be one fruit. A circle has 1,
two that touch have a half; clumps, branches and crowns have less."""
NARROWEST = 2.0
"""Width in pixels below which a region is noise."""
FEWEST_REGIONS = 5
"""Number of regions, over all views, that give a size."""
BANDWIDTH = 0.15
"""Deviation of log width within which regions count as equally wide."""
SPREAD = 0.35
"""Standard deviation of log diameter between fruit: partly hidden fruit are narrower, blurred ones wider."""


@dataclass(frozen=True)
class PictureSize(FruitSize):
    """pixels: median width of the regions of about that size, in pixels of the rendered views."""

    pixels: float


def size_from_pictures(pictures: Sequence[Picture], threshold: float, contains: Contains) -> PictureSize | None:
    """The most common width of the regions whose blended probability reaches `threshold`; None with too few regions.

    A region's width is the diameter of its largest inscribed circle. Wide regions weigh more, because a pixel is a
    smaller part of them. contains: which positions (M, 3) belong to the part of the scene that is counted.
    """
    found = [_widths(picture, threshold, contains) for picture in pictures]
    pixels, widths = np.concatenate(found, axis=1) if found else np.zeros((2, 0))
    if len(widths) < FEWEST_REGIONS:
        return None
    logs = np.log(widths)
    places = np.arange(logs.min(), logs.max() + 0.02, 0.02)
    density = (pixels * np.exp(-0.5 * ((places[:, None] - logs) / BANDWIDTH) ** 2)).sum(axis=1)
    mode = places[int(density.argmax())]
    near = np.abs(logs - mode) < 2.0 * BANDWIDTH
    return PictureSize(float(np.exp(mode)), SPREAD, float(np.median(pixels[near])))


def _widths(picture: Picture, threshold: float, contains: Contains) -> FloatArray:
    """(2, R) widths of the round regions of a view, in pixels and in scene units; those cut by its border are left
    out."""
    shown = (picture.fruit >= threshold) & (picture.depth < NOTHING)
    labels, count = ndimage.label(shown)
    if count == 0:
        return np.zeros((2, 0))
    distances = ndimage.distance_transform_edt(shown)
    regions = np.arange(1, count + 1)
    row, column = np.array(ndimage.maximum_position(distances, labels, regions)).T
    pixels = 2.0 * distances[row, column] - 1.0
    areas = np.bincount(labels.reshape(-1), minlength=count + 1)[1:]
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    used = (pixels >= NARROWEST) & (0.25 * np.pi * pixels**2 >= LEAST_ROUND * areas) & ~np.isin(regions, border)
    row, column, pixels = row[used], column[used], pixels[used]
    depths, camera = picture.depth[row, column].astype(np.float64), picture.camera
    rays = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1) @ np.linalg.inv(camera.K).T
    positions = (rays * depths[:, None]) @ camera.world_to_camera[:3, :3] + camera.center
    widths: FloatArray = np.stack([pixels, pixels * depths / focal_length(camera)])
    return widths[:, contains(positions)]
