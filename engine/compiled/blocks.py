"""Gaussians handed out to threads in blocks, to whichever thread is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .jit import njit
from .lanes import take

BLOCK = 512
"""Gaussians a thread works on before it asks for more."""


@njit
def next_block(counter: NDArray[np.int64], n: int) -> tuple[int, int]:
    """First and last + 1 of the next block of n Gaussians that no thread has; an empty range when none is left."""
    begin = min(take(counter) * BLOCK, n)
    return begin, min(begin + BLOCK, n)
