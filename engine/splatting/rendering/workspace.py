"""Arrays that are reused from one step to the next."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray


class Workspace:
    """Provides uninitialised arrays by name; the memory of a name is kept and grows as needed.

    A training step needs tens of megabytes for moments. Allocating them each time would cost more time in page faults
    than the arithmetic. Requesting a name again overwrites its earlier content.
    """

    def __init__(self) -> None:
        self._kept: dict[str, NDArray[Any]] = {}

    def take(self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """An array of this shape with arbitrary content."""
        size = math.prod(shape)
        kept = self._kept.get(name)
        if kept is None or kept.size < size or kept.dtype != dtype:
            kept = self._kept[name] = np.empty(size + size // 4, dtype)
        return kept[:size].reshape(shape)

    def zeros(self, name: str, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """Zeros at first, then the same array with its last content, as long as the shape is the same."""
        kept = self._kept.get(name)
        if kept is None or kept.shape != shape or kept.dtype != dtype:
            kept = self._kept[name] = np.zeros(shape, dtype)
        return kept
