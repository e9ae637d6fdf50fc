"""Masks without a model: superpixels, merged by colour and edges into a hierarchy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from skimage.color import rgb2lab
from skimage.segmentation import felzenszwalb

from ...progress import Progress, silent
from .regions import RegionGraph
from .segments import Segments, number_masks

SEEN_SIDE = 640
"""Longest side, in pixels, of the copy that is segmented; larger photos are scaled down to it."""
LEVEL_COUNTS = (640, 340, 120)
"""Most regions per level: parts and small fruit, single fruit and leaves, clusters and branches."""
SUPERPIXEL_SCALE, SUPERPIXEL_BLUR, LEAST_PIXELS = 15.0, 0.5, 10
"""Parameters of Felzenszwalb and Huttenlocher's superpixels (2004): growth, blur before, smallest size."""


@dataclass(frozen=True)
class ClassicalSegmenter:
    """Three levels that cover the whole photo; each region of a level is a union of regions of the level before."""

    identity: str = "classical"

    def segment(self, image: NDArray[np.uint8], *, progress: Progress = silent) -> Segments:
        """See `Segmenter`."""
        progress(0.0, "merging superpixels")
        height, width = image.shape[:2]
        colours = rgb2lab(_shrink(image))
        superpixels = felzenszwalb(
            colours / 100.0,
            scale=SUPERPIXEL_SCALE,
            sigma=SUPERPIXEL_BLUR,
            min_size=LEAST_PIXELS,
        )
        graph = RegionGraph(superpixels, colours)
        rows, columns = (
            np.minimum((np.arange(side) + 0.5) * seen / side, seen - 1).astype(np.intp)
            for side, seen in zip((height, width), superpixels.shape, strict=True)
        )
        levels = [graph.merge_until(count).astype(np.int32)[superpixels] for count in LEVEL_COUNTS]
        segments = number_masks(np.stack(levels))
        return Segments(segments.labels.take(rows, axis=1).take(columns, axis=2), segments.count)


def _shrink(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Shrink the photo so that its longer side is at most SEEN_SIDE."""
    height, width = image.shape[:2]
    shrink = SEEN_SIDE / max(height, width)
    if shrink >= 1.0:
        return image
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BOX))
