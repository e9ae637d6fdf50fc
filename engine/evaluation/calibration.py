"""Checks whether probabilities and intervals are calibrated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import CountingError

FloatArray = NDArray[np.float64]

BINS = 15


@dataclass(frozen=True, eq=False)
class Reliability:
    """Bins of probabilities: each one's share of the mass, mean probability and mean outcome, (B,) each."""

    masses: FloatArray
    predicted: FloatArray
    observed: FloatArray

    @property
    def error(self) -> float:
        """Expected calibration error: Σ_b mass · |mean outcome − mean probability|; NaN without bins."""
        if len(self.masses) == 0:
            return float("nan")
        return float((self.masses * np.abs(self.observed - self.predicted)).sum())


def reliability(
    probabilities: FloatArray, outcomes: NDArray[np.bool_], *, weights: FloatArray | None = None, bins: int = BINS
) -> Reliability:
    """How often events of a given probability occurred, in bins of equal mass.

    probabilities: (N,) in [0, 1]; outcomes: (N,) whether the event occurred; weights: (N,) above 0, equal if not given.
    Equal probabilities stay in one bin, so that the order of the inputs changes nothing (Guo et al. 2017, eq. 3, with
    bins of equal mass as Nguyen & O'Connor 2015). Bins without mass are left out.

    Raises:
        CountingError: shapes differ, or a probability is not in [0, 1].
    """
    probabilities = np.asarray(probabilities, np.float64).reshape(-1)
    hits = np.asarray(outcomes, bool).reshape(-1)
    if len(probabilities) != len(hits):
        raise CountingError(f"There are {len(probabilities)} probabilities and {len(hits)} outcomes. Give as many")
    if not ((probabilities >= 0.0) & (probabilities <= 1.0)).all():  # also NaN
        raise CountingError("A probability is not a number from 0 to 1")
    mass = np.ones(len(probabilities)) if weights is None else np.asarray(weights, np.float64).reshape(-1)
    mass = mass / mass.sum()
    level_of = np.unique(probabilities, return_inverse=True)[1]
    of_level = np.bincount(level_of, mass)
    # The bin of a level is where the middle of its mass falls.
    bin_of = np.minimum((bins * (np.cumsum(of_level) - 0.5 * of_level)).astype(np.int64), bins - 1)[level_of]
    masses = np.asarray(np.bincount(bin_of, mass, bins), np.float64)
    filled = masses > 0
    predicted, observed = (np.bincount(bin_of, mass * values, bins)[filled] for values in (probabilities, hits))
    return Reliability(masses[filled], predicted / masses[filled], observed / masses[filled])


def calibration_error(
    probabilities: FloatArray, outcomes: NDArray[np.bool_], *, bins: int = BINS, balanced: bool = False
) -> float:
    """Expected calibration error of (N,) probabilities (see `reliability`); NaN for N = 0.

    balanced: both outcomes get the same total weight, however rare one is, if both occur.

    Raises:
        CountingError: shapes differ, or a probability is not in [0, 1].
    """
    hits = np.asarray(outcomes, bool).reshape(-1)
    both = balanced and hits.any() and not hits.all()
    return reliability(probabilities, hits, weights=balance_weights(hits) if both else None, bins=bins).error


def balance_weights(outcomes: NDArray[np.bool_], weights: FloatArray | None = None) -> FloatArray:
    """Return weights (N,) that sum to one half over each of the two outcomes, both of which occur."""
    given = np.ones(len(outcomes)) if weights is None else weights
    return np.where(outcomes, 0.5 * given / given[outcomes].sum(), 0.5 * given / given[~outcomes].sum())


def interval_coverage(low: FloatArray, high: FloatArray, true: FloatArray) -> float:
    """Share of the intervals [low, high], (N,) each, that contain their true value; NaN for none."""
    low, high, true = (np.asarray(values, np.float64).reshape(-1) for values in (low, high, true))
    return float(((low <= true) & (true <= high)).mean()) if len(true) else float("nan")
