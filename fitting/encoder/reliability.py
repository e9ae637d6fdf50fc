"""Calibration of probabilities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...engine.evaluation.calibration import balance_weights, reliability

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Judged:
    """Errors with both classes weighted to half of the mass, and their bins.

    calibration_error: expected calibration error; brier: mean squared error; constant_brier: that of always answering
    one half, whose calibration error is 0 although it is not informative.
    """

    calibration_error: float
    brier: float
    constant_brier: float
    predicted: tuple[float, ...]
    observed: tuple[float, ...]


def judge_probabilities(
    probability: FloatArray, truth: NDArray[np.bool_], prior: float, weights: FloatArray | None = None
) -> Judged | None:
    """Measure the errors of (M,) probabilities that were calibrated for a share `prior` of true ones; None if one class
    is missing.

    weights: (M,) weight of each; equal without them. Most pixels are sky, grass and leaf, which are easily recognised;
    unweighted, they would make any predictor look calibrated. So both classes weigh one half, and the probabilities are
    moved to that prior by Bayes' rule: logit p − logit prior.
    """
    if truth.all() or not truth.any():
        return None
    odds = np.clip(probability, 1e-9, 1.0 - 1e-9)
    moved = 1.0 / (1.0 + (1.0 - odds) / odds * prior / (1.0 - prior))
    mass = balance_weights(truth, weights)
    bins = reliability(moved, truth, weights=mass)
    return Judged(
        calibration_error=bins.error,
        brier=float((mass * (moved - truth) ** 2).sum()),
        constant_brier=0.25,
        predicted=tuple(bins.predicted.tolist()),
        observed=tuple(bins.observed.tolist()),
    )
