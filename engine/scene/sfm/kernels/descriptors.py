"""Kernels that compare 8-bit descriptors: the two best of each row of a product, and the best along epipolar lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ....compiled.jit import kernel, njit, prange

ROWS = 64
"""Rows or columns that a thread takes at a time."""


@kernel(fastmath=False)
def best_of_rows(
    products: NDArray[np.float32],
    best: NDArray[np.float32],
    second: NDArray[np.float32],
    column: NDArray[np.int32],
) -> None:
    """The largest and second largest of each row of `products` (R, C), and the first column of the largest."""
    for i in prange(products.shape[0]):
        row = products[i]
        largest = np.float32(-1.0)
        for j in range(row.shape[0]):
            largest = max(largest, row[j])
        at = 0
        while row[at] != largest:
            at += 1
        next_one = np.float32(-1.0)
        for j in range(at):
            next_one = max(next_one, row[j])
        for j in range(at + 1, row.shape[0]):
            next_one = max(next_one, row[j])
        best[i], second[i], column[i] = largest, next_one, at


@kernel(fastmath=False)
def best_of_columns(products: NDArray[np.float32], best: NDArray[np.float32]) -> None:
    """Raise `best` (C,) to the largest of each column of `products` (R, C)."""
    columns = products.shape[1]
    for block in prange((columns + ROWS - 1) // ROWS):
        start, end = block * ROWS, min((block + 1) * ROWS, columns)
        for i in range(products.shape[0]):
            for j in range(start, end):
                best[j] = max(best[j], products[i, j])


@njit(fastmath=False)
def _product(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> np.int32:
    total = np.int32(0)
    for k in range(128):
        total += np.int32(a[k]) * np.int32(b[k])
    return total


@kernel(fastmath=False)
def best_along_lines(
    lines: NDArray[np.float32],
    descriptors: NDArray[np.uint8],
    positions: NDArray[np.float32],
    others: NDArray[np.uint8],
    tolerance: float,
    best: NDArray[np.int32],
) -> None:
    """Compare each feature with the features of another photo near its epipolar line.

    lines: (N, 3) a, b, c of unit normal (a, b) in the other photo; descriptors: (N, 128); positions: (M, 2) pixels and
    others: (M, 128) of the other photo; tolerance: pixels from the line; best: (N, 3) the largest product, the second
    largest, and the other feature of the largest, -1 where there is none.
    """
    n, m = lines.shape[0], positions.shape[0]
    for block in prange((n + ROWS - 1) // ROWS):
        near = np.empty(m + 1, np.int32)
        for i in range(block * ROWS, min((block + 1) * ROWS, n)):
            a, b, c = lines[i, 0], lines[i, 1], lines[i, 2]
            count = 0
            for j in range(m):
                near[count] = j
                count += 1 if abs(a * positions[j, 0] + b * positions[j, 1] + c) < tolerance else 0
            first, second, at = np.int32(-1), np.int32(-1), np.int32(-1)
            for k in range(count):
                product = _product(descriptors[i], others[near[k]])
                if product > first:
                    first, second, at = product, first, near[k]
                elif product > second:
                    second = product
            best[i, 0], best[i, 1], best[i, 2] = first, second, at
