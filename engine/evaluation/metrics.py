"""How good a count is: predicted fruit matched one to one with true fruit.

A count ratio hides errors, because misses and doubles cancel; so every figure here comes from matched centres, and
lengths are in mean diameters of the true fruit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from .truth import Truth

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Matching:
    """Pairs of one predicted and one true fruit. predicted, true: (K,) indices; distances: (K,) scene units."""

    predicted: IntArray
    true: IntArray
    distances: FloatArray


@dataclass(frozen=True, kw_only=True)
class CountMetrics:
    """A count against its truth at one matching radius.

    Precision, recall and F1 are against visible fruit; `ignored` predictions lie on fruit that is not visible and count
    neither way. doubles: false predictions on a fruit that another prediction has; merges: missed fruit under a
    prediction that is matched with another fruit. count_error: predictions minus visible fruit; center_error: mean
    distance of matched centres in mean diameters; diameter_error, diameter_bias: mean absolute and mean signed relative
    error over matched fruit. Ratios without a denominator are NaN, except F1, which is 1 for nothing found where
    nothing is.
    """

    radius: float
    predicted: int
    visible: int
    matched: int
    ignored: int
    precision: float
    recall: float
    f1: float
    doubles: int
    merges: int
    count_error: int
    relative_count_error: float
    center_error: float
    diameter_error: float
    diameter_bias: float


def match_centers(predicted: FloatArray, true: FloatArray, radius: float) -> Matching:
    """Pair as many centres as lie within `radius`, and of all such pairings take the one of least total distance.

    predicted: (P, 3), true: (T, 3), radius in the same unit. By the Hungarian method.
    """
    if len(predicted) == 0 or len(true) == 0 or not radius > 0:
        none = np.zeros(0, np.int64)
        return Matching(none, none, np.zeros(0))
    distances = cdist(predicted, true)
    # A pair out of reach costs more than all pairs within reach together, so that the number of pairs comes first.
    cost = np.where(distances <= radius, distances, radius * (1.0 + min(distances.shape)) * 2.0)
    rows, columns = linear_sum_assignment(cost)
    close = distances[rows, columns] <= radius
    rows, columns = rows[close], columns[close]
    return Matching(rows.astype(np.int64), columns.astype(np.int64), distances[rows, columns])


def count_metrics(centers: FloatArray, diameters: FloatArray, truth: Truth, radius: float = 0.5) -> CountMetrics:
    """Measure predicted fruit against the truth.

    centers: (P, 3), diameters: (P,) scene units; radius: how far a matched centre may lie, in mean true diameters.
    Visible fruit are matched first; of the predictions left over, those matched with other true fruit are ignored.
    """
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    diameters = np.asarray(diameters, dtype=np.float64).reshape(-1)
    unit = truth.mean_diameter
    reach = radius * unit
    visible, hidden = np.flatnonzero(truth.visible), np.flatnonzero(~truth.visible)
    matching = match_centers(centers, truth.centers[visible], reach)
    left = np.setdiff1d(np.arange(len(centers)), matching.predicted)
    ignored = left[match_centers(centers[left], truth.centers[hidden], reach).predicted]
    false = np.setdiff1d(left, ignored)
    missed = np.setdiff1d(np.arange(len(visible)), matching.true)

    matched, judged = len(matching.true), len(centers) - len(ignored)
    precision = matched / judged if judged else float("nan")
    recall = matched / len(visible) if len(visible) else float("nan")
    relative = diameters[matching.predicted] / truth.diameters[visible[matching.true]] - 1.0
    count_error = len(centers) - len(visible)
    return CountMetrics(
        radius=radius,
        predicted=len(centers),
        visible=len(visible),
        matched=matched,
        ignored=len(ignored),
        precision=precision,
        recall=recall,
        f1=2.0 * matched / (judged + len(visible)) if judged + len(visible) else 1.0,
        doubles=_within(centers[false], truth.centers, np.full(len(truth.centers), reach)),
        merges=_within(
            truth.centers[visible[missed]],
            centers[matching.predicted],
            np.maximum(reach, diameters[matching.predicted] / 2.0),
        ),
        count_error=count_error,
        relative_count_error=count_error / len(visible) if len(visible) else float("nan"),
        center_error=float(matching.distances.mean() / unit) if matched else float("nan"),
        diameter_error=float(np.abs(relative).mean()) if matched else float("nan"),
        diameter_bias=float(relative.mean()) if matched else float("nan"),
    )


def _within(points: FloatArray, centers: FloatArray, reaches: FloatArray) -> int:
    """How many of the points (A, 3) lie within its reach (B,) of any centre (B, 3)."""
    if len(points) == 0 or len(centers) == 0:
        return 0
    return int((cdist(points, centers) <= reaches).any(axis=1).sum())
