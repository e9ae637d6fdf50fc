"""Which photos are compared: the nearest, and those of other passes of the walk along the same place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, minimum_filter1d

_NEAREST = 12
"""Photos with the lowest cost that each one is compared with."""
_APART = 10
"""Photos in name order, before and after one, with higher costs, if a pass of the walk is nearest there."""
_PASSES = 3
"""Passes of the walk that each photo is compared with, its own included: with the nearest photo of each, the one before
and the one after it. Where steps are small, all nearest photos are of one pass, and nothing joins it with others."""


def near_photos(cost: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pairs of a row and a photo that it is compared with, (M,) each, ordered by both.

    cost: (N, V) of comparing with each of the photos in name order; infinite where they must not be compared, as with
    itself.
    """
    chosen = _passes(cost)
    ranked = np.argsort(cost, axis=1, kind="stable")[:, :_NEAREST]
    np.put_along_axis(chosen, ranked, True, axis=1)
    row, photo = np.nonzero(chosen & np.isfinite(cost))
    return row, photo


def _passes(cost: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N, V) the nearest photos of the nearest passes."""
    lowest = minimum_filter1d(cost, 2 * _APART + 1, axis=1, mode="constant", cval=np.inf)
    nearest = np.where(cost == lowest, cost, np.inf)
    last = min(_PASSES, cost.shape[1]) - 1
    nearest[nearest > np.partition(nearest, last, axis=1)[:, last, None]] = np.inf
    return maximum_filter1d(np.isfinite(nearest), 3, axis=1, mode="constant", cval=False)
