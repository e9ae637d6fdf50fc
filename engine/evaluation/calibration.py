"""Whether probabilities and intervals mean what they say."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import CountingError

FloatArray = NDArray[np.float64]

BINS = 15


def calibration_error(
    probabilities: FloatArray, outcomes: NDArray[np.bool_], *, bins: int = BINS, balanced: bool = False
) -> float:
    """Expected calibration error: Σ_b w_b |mean outcome − mean probability| over bins of equal mass.

    probabilities: (N,) in [0, 1]; outcomes: (N,) whether it was so; balanced: both outcomes weigh the same in all,
    however rare one is, where both occur. NaN for N = 0. Equal probabilities stay in one bin, so that the order of the
    inputs changes nothing (Guo et al. 2017, eq. 3, with bins of equal mass as Nguyen & O'Connor 2015).

    Raises:
        CountingError: shapes differ, or a probability is not in [0, 1].
    """
    chances = np.asarray(probabilities, np.float64).reshape(-1)
    hits = np.asarray(outcomes, bool).reshape(-1)
    if len(chances) != len(hits):
        raise CountingError(f"there are {len(chances)} probabilities and {len(hits)} outcomes; give as many")
    if not ((chances >= 0.0) & (chances <= 1.0)).all():  # also NaN
        raise CountingError("a probability is not a number from 0 to 1")
    if len(chances) == 0:
        return float("nan")
    weights = np.ones(len(chances))
    if balanced and hits.any() and not hits.all():
        weights = np.where(hits, 0.5 / hits.sum(), 0.5 / (~hits).sum())
    weights = weights / weights.sum()
    level_of = np.unique(chances, return_inverse=True)[1]
    mass = np.bincount(level_of, weights)
    # The bin of a level is where the middle of its mass falls.
    bin_of = np.minimum((bins * (np.cumsum(mass) - 0.5 * mass)).astype(np.int64), bins - 1)[level_of]
    gaps = np.bincount(bin_of, weights * (hits - chances), minlength=bins)
    return float(np.abs(gaps).sum())


def interval_coverage(low: FloatArray, high: FloatArray, true: FloatArray) -> float:
    """Share of the intervals [low, high], (N,) each, that hold their true value; NaN for none."""
    low, high, true = (np.asarray(values, np.float64).reshape(-1) for values in (low, high, true))
    return float(((low <= true) & (true <= high)).mean()) if len(true) else float("nan")
