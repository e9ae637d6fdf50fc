"""Masks of a photo at several levels, with the features of a crop encoder."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Segments:
    """The masks of one photo. Masks of one level do not overlap; those of a later level are larger.

    labels: (L, H, W) int32, which mask a pixel lies in at each level, -1 for none; numbers run from 0 to count - 1 over
    all levels together, and each is used.
    """

    labels: NDArray[np.int32]
    count: int


@dataclass(frozen=True, eq=False)
class SegmentedView:
    """One photo's masks with a feature each.

    labels: (L, H, W) int32 at the camera's size, row of `vectors` or -1; vectors: (M, D) unit float32.
    """

    labels: NDArray[np.int32]
    vectors: Tensor


def number_masks(labels: NDArray[np.int32]) -> Segments:
    """Number masks from labels (L, H, W) whose numbers, -1 for none, may have gaps and may repeat at another level."""
    result, count = np.empty_like(labels), 0
    for level, given in enumerate(labels):
        used = np.bincount(given.ravel() + 1)[1:] > 0
        names = np.full(len(used) + 1, -1, np.int32)  # the last one is that of -1
        names[:-1][used] = count + np.arange(used.sum(), dtype=np.int32)
        result[level] = names[given]
        count += int(used.sum())
    return Segments(result, count)
