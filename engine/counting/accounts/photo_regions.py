"""Regions of the photos that match the prompt: how many fruit there may be if none was counted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ...language.prompts.photo_probability import PhotoMap
from ...scene.camera import Camera
from ..evidence.picture_size import Regions
from ..evidence.pixel_width import focal_length

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_PIXELS = 4
"""Pixels of a map below which a region is noise."""
LEAST_PHOTOS, LEAST_SHARE = 3, 0.1
"""Photos that must show a place, and their share of the photos that frame it: where 3 % of each photo match, 3 of 60
photos show a place by accident, 6 do not."""
WIDER = 2.0
"""Diameters of a fruit from which a region is one object, not touching fruit."""


@dataclass(frozen=True, eq=False)
class PhotoRegions:
    """Connected regions of pixels that match the prompt in V photos.

    cameras: of the photos; labels: (H, W) of each photo, the number of the region of a pixel, 0 for none; widths:
    (R + 1,) of each photo, the diameter of the largest circle inside each region in pixels of the camera, by its
    number; probabilities: (R,) of each photo, the mean over each region.
    """

    cameras: Sequence[Camera]
    labels: Sequence[IntArray]
    widths: Sequence[FloatArray]
    probabilities: Sequence[FloatArray]

    @classmethod
    def of(cls, maps: Sequence[PhotoMap], cameras: Sequence[Camera], threshold: float) -> PhotoRegions:
        """The regions whose pixels reach `threshold`."""
        found = [_regions(each.probability, camera, threshold) for each, camera in zip(maps, cameras, strict=True)]
        labels, widths, probabilities = zip(*found, strict=True)
        return cls(cameras, labels, widths, probabilities)

    @property
    def at_once(self) -> int:
        """The number of regions that at least LEAST_PHOTOS photos show at the same time."""
        numbers = sorted((len(each) for each in self.probabilities), reverse=True)
        return numbers[LEAST_PHOTOS - 1] if len(numbers) >= LEAST_PHOTOS else 0

    @property
    def probability(self) -> float:
        """The median probability of a region; NaN without any."""
        return _median(np.concatenate(self.probabilities))

    @property
    def width(self) -> float:
        """The median width of a region in pixels of its camera; NaN without any."""
        return _median(np.concatenate([each[1:] for each in self.widths]))

    def count_places(self, positions: FloatArray, diameter: float | None) -> int:
        """The number of places that enough photos show, see LEAST_PHOTOS: about one for each fruit.

        positions: (M, 3) on surfaces, the most probable first; diameter: of a fruit, None if it is not known, all in
        scene units. Places are a diameter apart; where the region is WIDER than fruit, or the diameter is not known,
        they are a width of the region apart.
        """
        framed, shown, sizes = (np.zeros(len(positions)) for _ in range(3))
        for camera, labels, widths in zip(self.cameras, self.labels, self.widths, strict=True):
            inside, pixels, depths = camera.find_in_frame(positions)
            columns, rows = (pixels[inside] * labels.shape[::-1] / (camera.width, camera.height)).astype(np.int64).T
            numbers = labels[rows, columns]
            framed += inside
            shown[inside] += numbers > 0
            sizes[inside] += widths[numbers] * depths[inside] / focal_length(camera)
        agreed = np.flatnonzero((shown >= LEAST_PHOTOS) & (shown >= LEAST_SHARE * framed))
        wide = sizes[agreed] / shown[agreed]
        own = wide if diameter is None else np.where(wide > WIDER * diameter, wide, diameter)
        return _count_apart(positions[agreed], own)


def _regions(
    probability: NDArray[np.float32], camera: Camera, threshold: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """The labels (H, W) of a map, the widths (R + 1,) of its regions, 0 for none, and their probabilities (R,)."""
    shown = probability >= threshold
    found, (labels, count) = Regions.of(shown), ndimage.label(shown)
    kept = found.areas >= LEAST_PIXELS
    numbers = np.concatenate([[0], np.where(kept, np.cumsum(kept), 0)])
    means = np.asarray(ndimage.mean(probability, labels, np.arange(1, count + 1)), np.float64).reshape(-1)
    widths = np.concatenate([[0.0], found.widths[kept]]) * camera.width / probability.shape[1]
    return numbers[labels], widths, means[kept]


def _count_apart(positions: FloatArray, distances: FloatArray) -> int:
    """How many of the positions (M, 3), taken in their order, are farther from all that were taken before than the
    distances (M,) of these and their own."""
    free, count = np.ones(len(positions), bool), 0
    for index in range(len(positions)):
        if free[index]:
            count += 1
            away = np.linalg.norm(positions - positions[index], axis=1)
            free &= away >= np.maximum(distances, distances[index])
    return count


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
