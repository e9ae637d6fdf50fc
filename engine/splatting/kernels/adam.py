"""One step of Adam over the Gaussians that a view rendered (Kingma & Ba 2015, algorithm 1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import next_block
from ...compiled.jit import kernel, njit, prange

BETA_1, BETA_2 = np.float32(0.9), np.float32(0.999)
EPSILON = np.float32(1e-15)
ONE = np.float32(1)
_t = np.maximum(np.arange(20_000), 1)
CORRECTIONS = np.stack([1 / (1 - 0.9**_t), (1 - 0.999**_t) ** -0.5], 1).astype(np.float32)
"""(T, 2) 1 / (1 - β₁ᵗ) and (1 - β₂ᵗ)^-½ after t updates; the last row, 1 to seven digits, serves all later ones."""


@njit
def _step_row(
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    rates: NDArray[np.float32],
    scale: float,
    correction: float,
) -> None:
    for k in range(rates.shape[0]):
        g = gradients[k]
        m = BETA_1 * first[k] + (ONE - BETA_1) * g
        v = BETA_2 * second[k] + (ONE - BETA_2) * g * g
        first[k] = m
        second[k] = v
        parameters[k] -= rates[k] * scale * m / (math.sqrt(v) * correction + EPSILON)


@kernel
def adam_step(
    workers: int,
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    rates: NDArray[np.float32],
    drawn: NDArray[np.int32],
    updates: NDArray[np.int32],
    corrections: NDArray[np.float32],
) -> None:
    """Update tables (N, K) in place, only the rows of Gaussians that were drawn.

    rates: learning rates of the first columns; the others are not updated. drawn: (N,) not 0 if a view rendered it;
    updates: (N,) number of updates of each row, this step included, for the bias correction of both moments: a row that
    is rarely in view still has young moments. Moments that start later, of a new degree of the harmonics or after an
    opacity reset, are treated as old ones, as in 3DGS: their first steps are up to six times the rate. corrections:
    `CORRECTIONS`.
    """
    n = parameters.shape[0]
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        begin, end = next_block(counter, n)
        while begin < end:
            for i in range(begin, end):
                if drawn[i] == 0:
                    continue
                t = min(updates[i], corrections.shape[0] - 1)
                _step_row(parameters[i], gradients[i], first[i], second[i], rates, corrections[t, 0], corrections[t, 1])
            begin, end = next_block(counter, n)
