"""Points by density: DBSCAN with a threshold that follows the scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..evidence.claims import members
from ..geometry.cells import Cells, find_least_near, link_points

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_POINTS = 4
"""Lower bound of DBSCAN's min_samples: three points are always a chain."""


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
    """The points of each cluster of positions (P, 3), by DBSCAN.

    reach: ε, in the unit of the positions; min_samples is `share` of the typical number of neighbours within it.
    """
    labels = dbscan(positions, reach, max(LEAST_POINTS, round(share * density.usual)))
    return members(labels, int(labels.max(initial=-1)) + 1)


def dbscan(positions: FloatArray, reach: float, least: int) -> IntArray:
    """(P,) the number of each point's cluster, -1 none: DBSCAN (Ester et al. 1996) of positions (P, 3).

    A point with `least` neighbours within `reach`, itself included, is a core point; core points in reach of each other
    are of one cluster, and every other point is of the clusters of the core points in its reach. Clusters are numbered
    by their first core points; a point of several belongs to the first, as in scikit-learn. scikit-learn keeps all
    pairs of neighbours, which takes more than 14 GB for 60,000 points at one position.
    """
    labels = np.full(len(positions), -1, np.int64)
    cells = Cells.of(positions, reach)
    is_core = np.zeros(len(positions), bool)
    is_core[cells.index] = cells.numbers(cells.positions, np.full(len(positions), reach)) >= least
    core, others = np.flatnonzero(is_core), np.flatnonzero(~is_core)
    cells = Cells.of(positions[core], reach)
    clusters = link_points(cells.table, reach, 0.0)
    first = np.full(len(core), len(core))
    np.minimum.at(first, clusters, cells.index)
    numbers = np.unique(first[clusters], return_inverse=True)[1]
    labels[core[cells.index]] = numbers
    labels[others] = find_least_near(cells, numbers, positions[others], reach, least)
    return labels
