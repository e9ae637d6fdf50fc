"""The distance of rendered codes from those of the masks (paper eq. 8), and its gradient."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, prange

ZERO, ONE, TINY = np.float32(0), np.float32(1), np.float32(1e-20)
SHORTEST = np.float32(1e-3)
"""A rendered code shorter than this has no cosine: nothing is rendered there yet."""


@kernel
def semantic_loss(
    drawn: NDArray[Any],
    cells: NDArray[np.int32],
    codes: NDArray[Any],
    levels: int,
    weight: float,
    gradient: NDArray[np.float32],
    l1_sums: NDArray[np.float64],
    cosine_sums: NDArray[np.float64],
) -> None:
    """gradient (L · d, H, W): weight · d(Σ mean_d |F - H| + 1 - cos(F, H)) / dF, and both terms' sums by row (H,).

    drawn: (L · d, H, W) the rendered codes F; cells: (H, W) the row in codes of each pixel; codes: (C, L · d) H, unit
    for each level, or 0 if a level has no mask there, which does not count.
    """
    channels, height, width = drawn.shape
    size = channels // levels
    for y in prange(height):
        l1_sum, cosine_sum = 0.0, 0.0
        for x in range(width):
            row = codes[cells[y, x]]
            for level in range(levels):
                begin = level * size
                dot: Any = ZERO
                square: Any = ZERO
                here: Any = ZERO
                for k in range(begin, begin + size):
                    dot += drawn[k, y, x] * row[k]
                    square += drawn[k, y, x] * drawn[k, y, x]
                    here += row[k] * row[k]
                length = math.sqrt(square)
                known, long = here > ZERO, length > SHORTEST
                if known:
                    cosine_sum += ONE - dot / (length + TINY)
                for k in range(begin, begin + size):
                    slope = ZERO
                    if known:
                        away = drawn[k, y, x] - row[k]
                        l1_sum += abs(away) / np.float32(size)
                        if away > ZERO:
                            slope = ONE / np.float32(size)
                        elif away < ZERO:
                            slope = -ONE / np.float32(size)
                        if long:
                            slope -= (row[k] - drawn[k, y, x] * dot / square) / length
                    gradient[k, y, x] = np.float32(weight) * slope
        l1_sums[y] = l1_sum
        cosine_sums[y] = cosine_sum
