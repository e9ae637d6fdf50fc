"""One step of Adam over a table of parameters (Kingma & Ba 2015, algorithm 1)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, njit, prange

BETA_1, BETA_2 = np.float32(0.9), np.float32(0.999)
EPSILON = np.float32(1e-15)
ONE = np.float32(1)


@njit
def _step_run(
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    rates: NDArray[np.float32],
    correction: float,
) -> None:
    for k in range(parameters.shape[0]):
        g = gradients[k]
        m = BETA_1 * first[k] + (ONE - BETA_1) * g
        v = BETA_2 * second[k] + (ONE - BETA_2) * g * g
        first[k] = m
        second[k] = v
        parameters[k] -= rates[k] * m / (math.sqrt(v) * correction + EPSILON)


@kernel
def adam_step(
    parameters: NDArray[np.float32],
    gradients: NDArray[np.float32],
    first: NDArray[np.float32],
    second: NDArray[np.float32],
    rates: NDArray[np.float32],
    correction: float,
) -> None:
    """Update flat parameters in place; the gradients and both moments are as long.

    rates: learning rates divided by 1 - β₁ᵗ, repeated along the parameters; correction: (1 - β₂ᵗ)^-½.
    """
    size, run = parameters.shape[0], rates.shape[0]
    for k in prange((size + run - 1) // run):
        part = slice(k * run, min((k + 1) * run, size))
        _step_run(parameters[part], gradients[part], first[part], second[part], rates, correction)
