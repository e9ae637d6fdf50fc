"""Points by how densely they lie: DBSCAN with a threshold that follows the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sklearn.cluster import DBSCAN

from .claims import members

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_POINTS = 4
"""DBSCAN's min_samples is never below this: three points are always a chain."""


@dataclass(frozen=True, eq=False)
class Density:
    """numbers: (P,) points within a reach of each point, itself included; usual: their median."""

    numbers: IntArray
    usual: float

    @classmethod
    def of(cls, positions: FloatArray, reach: float) -> Density:
        """Count the neighbours of positions (P, 3) within `reach`."""
        numbers = cKDTree(positions).query_ball_point(positions, reach, return_length=True)
        return cls(numbers, float(np.median(numbers)))


def dense_clusters(positions: FloatArray, reach: float, density: Density, share: float) -> list[IntArray]:
    """The points of each cluster of positions (P, 3), by DBSCAN (Ester et al. 1996).

    reach: ε, in the unit of the positions; min_samples is `share` of the usual number of neighbours within it.
    """
    if len(positions) == 0:
        return []
    least = max(LEAST_POINTS, round(share * density.usual))
    labels = DBSCAN(eps=reach, min_samples=least).fit_predict(positions).astype(np.int64)
    return members(labels, int(labels.max()) + 1)
