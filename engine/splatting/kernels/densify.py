"""The contribution of a view to the gradient statistics of each Gaussian."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, prange

ONE = np.float32(1)


@kernel
def count_views(
    workers: int,
    mean_gradients: NDArray[np.float32],
    drawn: NDArray[np.int32],
    half_width: float,
    half_height: float,
    sums: NDArray[np.float32],
    counts: NDArray[np.float32],
) -> None:
    """Add one view: lengths of mean_gradients (N, 2), per pixel, to sums (N,) in half-images; 1 to counts (N,) if
    rendered."""
    n = drawn.shape[0]
    for worker in prange(workers):
        for i in range(worker * n // workers, (worker + 1) * n // workers):
            if drawn[i] != 0:
                x, y = mean_gradients[i, 0] * half_width, mean_gradients[i, 1] * half_height
                sums[i] += math.sqrt(x * x + y * y)
                counts[i] += ONE
