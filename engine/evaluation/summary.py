"""Bias and error of counts over scenes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .metrics import CountMetrics


@dataclass(frozen=True, kw_only=True)
class Summary:
    """Counts of S scenes together, against visible fruit.

    f1, precision, recall: means over scenes; bias: Σ predicted ÷ Σ visible − 1; mape: mean |predicted ÷ visible − 1|
    over scenes that have fruit. NaN without scenes.
    """

    scenes: int
    f1: float
    precision: float
    recall: float
    bias: float
    mape: float


def summarise(rows: Sequence[CountMetrics]) -> Summary:
    """The mean of the scenes' figures; a precision or recall without a denominator is left out of its mean."""
    visible = np.array([row.visible for row in rows], float)
    predicted = np.array([row.predicted for row in rows], float)
    some = visible > 0
    return Summary(
        scenes=len(rows),
        f1=_mean([row.f1 for row in rows]),
        precision=_mean([row.precision for row in rows]),
        recall=_mean([row.recall for row in rows]),
        bias=float(predicted.sum() / visible.sum() - 1.0) if visible.sum() else float("nan"),
        mape=float(np.abs(predicted[some] / visible[some] - 1.0).mean()) if some.any() else float("nan"),
    )


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
