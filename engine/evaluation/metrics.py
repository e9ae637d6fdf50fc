"""Accuracy of a count: predicted fruit matched one to one with true fruit.

A ratio of counts hides errors, because misses and doubles cancel. So every figure is based on matched centres, and
lengths are in mean diameters of the true fruit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .judgement import FloatArray, Judgement, judge
from .truth import Truth

VISIBILITY_EDGES = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0)
"""Bounds of the classes of visible fraction."""


@dataclass(frozen=True, kw_only=True)
class CountMetrics:
    """A count against its truth at one matching radius.

    Precision, recall and F1 are against visible fruit; `ignored` predictions lie on fruit that is not visible and do
    not count. doubles: false predictions on a fruit that another prediction has; merges: missed fruit under a
    prediction that is matched with another fruit. count_error: predictions minus visible fruit; total: all true fruit;
    center_error: mean distance of matched centres in mean diameters; diameter_error, diameter_bias: mean absolute and
    mean signed relative error over matched fruit. Ratios without a denominator are NaN, except F1, which is 1 if there
    is no fruit and none was found.
    """

    radius: float
    predicted: int
    visible: int
    total: int
    matched: int
    ignored: int
    precision: float
    recall: float
    f1: float
    doubles: int
    merges: int
    count_error: int
    relative_count_error: float
    relative_total_error: float
    center_error: float
    diameter_error: float
    diameter_bias: float


@dataclass(frozen=True, kw_only=True)
class VisibilityClass:
    """Visible true fruit whose visible fraction lies in [low, high), the last class also at `high`: their number, the
    share that was found, and their errors, as in `CountMetrics`; NaN if there are none."""

    low: float
    high: float
    visible: int
    recall: float
    center_error: float
    diameter_error: float


def count_metrics(centers: FloatArray, diameters: FloatArray, truth: Truth, radius: float = 0.5) -> CountMetrics:
    """Measure predicted fruit against the truth.

    centers: (P, 3), diameters: (P,) scene units; radius: largest distance of a matched centre, in mean true diameters.
    Visible fruit are matched first; of the remaining predictions, those that match other true fruit are ignored.

    Raises:
        CountingError: as `judge`.
    """
    return measure(judge(centers, diameters, truth, radius), truth)


def measure(judgement: Judgement, truth: Truth) -> CountMetrics:
    """Measure the figures of a judgement against `truth`."""
    predicted, visible = judgement.predictions, int(truth.visible.sum())
    total = truth.total
    matched, counted = len(judgement.pairs), predicted - len(judgement.ignored)
    errors = _errors(judgement, truth, np.ones(matched, bool))
    return CountMetrics(
        radius=judgement.radius,
        predicted=predicted,
        visible=visible,
        total=total,
        matched=matched,
        ignored=len(judgement.ignored),
        precision=_ratio(matched, counted),
        recall=_ratio(matched, visible),
        f1=2.0 * matched / (counted + visible) if counted + visible else 1.0,
        doubles=len(judgement.doubles),
        merges=len(judgement.merged),
        count_error=predicted - visible,
        relative_count_error=_ratio(predicted - visible, visible),
        relative_total_error=_ratio(predicted - total, total),
        center_error=errors.center,
        diameter_error=errors.diameter,
        diameter_bias=errors.diameter_bias,
    )


def measure_by_visibility(
    judgement: Judgement, truth: Truth, edges: Sequence[float] = VISIBILITY_EDGES
) -> list[VisibilityClass]:
    """Measure recall and errors by the largest visible fraction; edges: bounds of the classes, ascending."""
    classes = []
    last = len(edges) - 2
    for number, (low, high) in enumerate(pairwise(edges)):
        fractions = truth.visible_fractions
        inside = truth.visible & (fractions >= low) & ((fractions <= high) if number == last else (fractions < high))
        chosen = inside[judgement.pairs.true]
        errors = _errors(judgement, truth, chosen)
        classes.append(
            VisibilityClass(
                low=low,
                high=high,
                visible=int(inside.sum()),
                recall=_ratio(int(chosen.sum()), int(inside.sum())),
                center_error=errors.center,
                diameter_error=errors.diameter,
            )
        )
    return classes


@dataclass(frozen=True)
class _Errors:
    center: float
    diameter: float
    diameter_bias: float


def _errors(judgement: Judgement, truth: Truth, chosen: NDArray[np.bool_]) -> _Errors:
    """Mean errors over the chosen (K,) pairs; NaN without any."""
    if not chosen.any():
        return _Errors(float("nan"), float("nan"), float("nan"))
    pairs = judgement.pairs
    relative = judgement.diameters[pairs.predicted] / truth.diameters[pairs.true] - 1.0
    return _Errors(
        center=float(pairs.distances[chosen].mean() / truth.mean_diameter),
        diameter=float(np.abs(relative[chosen]).mean()),
        diameter_bias=float(relative[chosen].mean()),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
