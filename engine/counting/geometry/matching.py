"""One-to-one matching of two sets of centres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

ROUNDING = 1.0 + 1e-9
"""Factor by which neighbours are searched farther than their reach, so that rounding leaves none out."""


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

    predicted: (P, 3), true: (T, 3), radius in the same unit: one, or (T,) of each true centre. By the Hungarian method
    in every group of centres that are connected by distances within the radius, so memory grows with the pairs within
    reach and not with P · T.
    """
    reach = np.broadcast_to(np.asarray(radius, np.float64), len(true))
    rows, columns, distances = pairs_within(predicted, true, reach)
    if len(rows) == 0:
        none = np.zeros(0, np.int64)
        return Matching(none, none, np.zeros(0))
    chosen = np.concatenate(
        [_assign(rows, columns, distances, group) for group in _groups(rows, columns, len(predicted), len(true))]
    )
    chosen = chosen[np.argsort(rows[chosen])]
    return Matching(rows[chosen], columns[chosen], distances[chosen])


def pairs_within(points: FloatArray, centers: FloatArray, reaches: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """All pairs of a point (P, 3) and a center (T, 3) within the reach (T,) of the center.

    Returns the index of each pair's point (K,), that of its center (K,), and their distance (K,).
    """
    usable = np.flatnonzero(reaches > 0.0)
    if len(points) == 0 or len(usable) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    near = cKDTree(points).query_ball_point(centers[usable], ROUNDING * reaches[usable], return_sorted=True)
    rows = np.concatenate([np.asarray(each, np.int64) for each in near])
    columns = np.repeat(usable, [len(each) for each in near])
    distances = np.linalg.norm(points[rows] - centers[columns], axis=1)
    within = distances <= reaches[columns]
    return rows[within], columns[within], distances[within]


def _groups(rows: IntArray, columns: IntArray, predicted: int, true: int) -> list[IntArray]:
    """The pairs (K,) in groups that have no centre in common."""
    graph = coo_matrix((np.ones(len(rows)), (rows, predicted + columns)), shape=(predicted + true,) * 2)
    numbers = connected_components(graph, directed=False)[1][rows]
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1)


def _assign(rows: IntArray, columns: IntArray, distances: FloatArray, group: IntArray) -> IntArray:
    """The pairs of a group, indices into `rows`, `columns` and `distances` (K,), that match the most centres with the
    least total distance."""
    if len(group) == 1:
        return group
    own, row = np.unique(rows[group], return_inverse=True)
    other, column = np.unique(columns[group], return_inverse=True)
    number = np.full((len(own), len(other)), -1, np.int64)
    number[row, column] = group
    # A pair out of reach costs more than all pairs within reach together, so that the number of pairs comes first.
    cost = np.full(number.shape, (float(distances[group].max()) or 1.0) * (1.0 + min(number.shape)) * 2.0)
    cost[row, column] = distances[group]
    chosen = number[linear_sum_assignment(cost)]
    return chosen[chosen >= 0]
