"""One-to-one matching of two sets of centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Matching:
    """Pairs of one predicted and one true fruit. predicted, true: (K,) indices; distances: (K,) scene units."""

    predicted: IntArray
    true: IntArray
    distances: FloatArray

    def __len__(self) -> int:
        return len(self.predicted)


def match_centers(predicted: FloatArray, true: FloatArray, radius: float | FloatArray) -> Matching:
    """Match as many centres as possible within `radius`, with the least total distance.

    predicted: (P, 3), true: (T, 3), radius in the same unit: one, or (T,) of each true centre. By the Hungarian method.
    """
    longest = float(np.max(radius, initial=0.0))
    if len(predicted) == 0 or len(true) == 0 or not longest > 0:
        none = np.zeros(0, np.int64)
        return Matching(none, none, np.zeros(0))
    distances = cdist(predicted, true)
    within = distances <= radius
    # A pair out of reach costs more than all pairs within reach together, so that the number of pairs comes first.
    cost = np.where(within, distances, longest * (1.0 + min(distances.shape)) * 2.0)
    rows, columns = linear_sum_assignment(cost)
    close = within[rows, columns]
    rows, columns = rows[close], columns[close]
    return Matching(rows.astype(np.int64), columns.astype(np.int64), distances[rows, columns])
