"""Pictures of single masks for a crop encoder."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from .segments import Segments

LARGEST_SIDE = 448
"""Larger crops are scaled down to this many pixels per side: twice CLIP's input, so that nothing is lost."""


def crop_masks(image: NDArray[np.uint8], segments: Segments) -> Iterator[NDArray[np.uint8]]:
    """Yield one square picture (S, S, 3) per mask, in the order of their numbers: its content, centred on black.

    They are made one at a time, because a photo has hundreds. image: (H, W, 3) sRGB.
    """
    boxes: list[tuple[int, tuple[slice, slice]]] = [(-1, (slice(0), slice(0)))] * segments.count
    for level, labels in enumerate(segments.labels):
        for number, box in enumerate(ndimage.find_objects(labels + 1)):
            if box is not None:
                boxes[number] = (level, box)
    for number, (level, box) in enumerate(boxes):
        inside = segments.labels[level][box] == number
        yield _pad_to_square(np.where(inside[..., None], image[box], np.uint8(0)))


def _pad_to_square(crop: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Put a crop in the centre of a black square of at most LARGEST_SIDE, scaled down if necessary."""
    height, width = crop.shape[:2]
    side = max(height, width)
    if side > LARGEST_SIDE:
        size = max(1, round(width * LARGEST_SIDE / side)), max(1, round(height * LARGEST_SIDE / side))
        crop = np.asarray(Image.fromarray(crop).resize(size, Image.Resampling.BOX))
        height, width, side = *crop.shape[:2], LARGEST_SIDE
    square = np.zeros((side, side, 3), np.uint8)
    top, left = (side - height) // 2, (side - width) // 2
    square[top : top + height, left : left + width] = crop
    return square
