"""One step of Adam over a table of parameters (Kingma & Ba 2015, algorithm 1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, njit, prange

BETA_1, BETA_2 = np.float32(0.9), np.float32(0.999)
EPSILON = np.float32(1e-15)
ONE = np.float32(1)
BLOCK = 2048


@njit
def _step_row(
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    begin: int,
    end: int,
    rate: float,
    correction: float,
) -> None:
    for k in range(begin, end):
        g = gradients[k]
        m = BETA_1 * first[k] + (ONE - BETA_1) * g
        v = BETA_2 * second[k] + (ONE - BETA_2) * g * g
        first[k] = m
        second[k] = v
        parameters[k] -= rate * m / (math.sqrt(v) * correction + EPSILON)


@kernel
def adam_step(
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    head: int,
    used: int,
    head_rate: float,
    tail_rate: float,
    correction: float,
) -> None:
    """Update a table (N, D) in place; all four have its shape.

    The first `head` columns move by head_rate, the others up to `used` by tail_rate (both already divided by
    1 - β₁ᵗ), those beyond stay; correction is (1 - β₂ᵗ)^-½.
    """
    n, width = parameters.shape
    rows = max(BLOCK // width, 1)
    for block in prange((n + rows - 1) // rows):
        for i in range(block * rows, min((block + 1) * rows, n)):
            p, g, m, v = parameters[i], gradients[i], first[i], second[i]
            _step_row(p, g, m, v, 0, head, head_rate, correction)
            _step_row(p, g, m, v, head, used, tail_rate, correction)
