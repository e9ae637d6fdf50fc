"""The kernel of surface points: which of them lie inside Gaussians."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, prange
from ..geometry.cells import Table, count, walk

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
    positions = table[0]
    for g in prange(len(means)):
        if squares[g] <= 0.0:
            continue
        reach = np.sqrt(squares[g]) * scales[g].max()
        near = np.empty(count(table, means[g], reach), np.int64)
        for p in near[: walk(table, means[g], reach, 1.0, near)]:
            square = 0.0
            for axis in range(3):
                along = 0.0
                for i in range(3):
                    along += axes[g, i, axis] * (positions[p, i] - means[g, i])
                square += (along / scales[g, axis]) ** 2
            if square < squares[g]:
                covered[p] = True
