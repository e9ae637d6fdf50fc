"""Blocks of Gaussians for threads, given to whichever thread is free."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .jit import njit
from .lanes import take

BLOCK = 512
"""Gaussians per block."""


@njit
def next_block(counter: NDArray[np.int64], n: int) -> tuple[int, int]:
    """First and last + 1 of the next free block of n Gaussians; an empty range if none is left."""
    begin = min(take(counter) * BLOCK, n)
    return begin, min(begin + BLOCK, n)
