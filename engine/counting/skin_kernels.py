"""The loop behind points of the skin, compiled: which of them lie inside Gaussians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, prange
from .cells import Table, gather, walk

FloatArray = NDArray[np.float64]


@kernel
def cover(
    table: Table,
    means: FloatArray,
    axes: FloatArray,
    scales: FloatArray,
    squares: FloatArray,
    covered: NDArray[np.bool_],
) -> None:
    """Set covered (P,) of the points inside one of G ellipsoids; points in the order of the cells.

    axes: (G, 3, 3), columns are the directions of scales (G, 3); squares: (G,) of how many scales each reaches, 0 for
    one that covers nothing. Threads write the same value, if they meet.
    """
    positions, nothing = table[0], np.empty(0, np.int64)
    for g in prange(len(means)):
        if squares[g] <= 0.0:
            continue
        reach = np.sqrt(squares[g]) * scales[g].max()
        near = np.empty(walk(table, means[g], reach, nothing, 0), np.int64)
        for p in near[: gather(table, means[g], reach, near)]:
            square = 0.0
            for axis in range(3):
                along = 0.0
                for i in range(3):
                    along += axes[g, i, axis] * (positions[p, i] - means[g, i])
                square += (along / scales[g, axis]) ** 2
            if square < squares[g]:
                covered[p] = True
