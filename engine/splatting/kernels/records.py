"""The record of a Gaussian for blending: its ellipse on the image, colour and depth, as one cache line.

Exponents are powers of two: α(d) = 2^(log2 opacity - (A dx² + B dx dy + C dy²)).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import njit
from ...compiled.lanes import LANES

RECORD = 16
"""float32 values of a record: one cache line."""
(
    MEAN_X,
    MEAN_Y,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    LOG2_OPACITY,
    RED,
    GREEN,
    BLUE,
    DEPTH,
    HALF_WIDTH,
    HALF_HEIGHT,
    REACH,
    SHRINK,
) = range(14)
"""Mean and conic of the ellipse, then half the sides of the box in which α ≥ 1/255; REACH: the exponent at the edge of
the region where it is listed; SHRINK: how much smaller that region is than the box."""

TILE_WIDTH = LANES
TILE_HEIGHT = 16

SLACK = np.float32(1e-3)
"""Pixels added around each box, so that rounding never cuts off a pixel that blending would draw."""
LOG2_E = np.float32(math.log2(math.e))
LOG2_255 = np.float32(math.log2(255.0))
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)


@njit(fastmath=False)
def _band(record: NDArray[np.float32], top: float, bottom: float) -> tuple[float, float]:
    """Leftmost and rightmost x at which the ellipse α = τ meets the band top ≤ y ≤ bottom.

    Without fast arithmetic, like everything that determines a tile's number: it would assume that nothing is NaN.
    """
    a, b, c, reach = record[CONIC_A], record[CONIC_B], record[CONIC_C], record[REACH]
    low, high = top - record[MEAN_Y], bottom - record[MEAN_Y]
    extreme = b * record[HALF_WIDTH] * record[SHRINK] / (TWO * c)
    right_y = min(max(-extreme, low), high)
    left_y = min(max(extreme, low), high)
    right_root = math.sqrt(max(b * b * right_y * right_y - np.float32(4) * a * (c * right_y * right_y - reach), ZERO))
    left_root = math.sqrt(max(b * b * left_y * left_y - np.float32(4) * a * (c * left_y * left_y - reach), ZERO))
    inverse = HALF / a
    return (
        record[MEAN_X] + (-b * left_y - left_root) * inverse - SLACK,
        record[MEAN_X] + (-b * right_y + right_root) * inverse + SLACK,
    )


@njit(fastmath=False)
def tile_rows(record: NDArray[np.float32], height: int) -> tuple[int, int]:
    """First and last + 1 row of tiles that the ellipse meets."""
    half = record[HALF_HEIGHT] * record[SHRINK]
    first = max(math.ceil(record[MEAN_Y] - half - HALF - SLACK), 0)
    last = min(math.floor(record[MEAN_Y] + half - HALF + SLACK), height - 1)
    if not first <= last:
        return 0, 0
    return int(first) // TILE_HEIGHT, int(last) // TILE_HEIGHT + 1


@njit(fastmath=False)
def tile_columns(record: NDArray[np.float32], tile_row: int, width: int) -> tuple[int, int]:
    """First and last + 1 tile of a row of tiles that the ellipse meets (exactly: its extent within those rows)."""
    top = np.float32(tile_row * TILE_HEIGHT) + HALF
    half = record[HALF_HEIGHT] * record[SHRINK]
    top = max(top, record[MEAN_Y] - half)
    bottom = np.float32(tile_row * TILE_HEIGHT + TILE_HEIGHT) - HALF
    bottom = min(bottom, record[MEAN_Y] + half)
    if top > bottom + SLACK:
        return 0, 0
    left, right = _band(record, top, bottom)
    first = max(math.ceil(left - HALF), 0)
    last = min(math.floor(right - HALF), width - 1)
    if not first <= last:
        return 0, 0
    return int(first) // TILE_WIDTH, int(last) // TILE_WIDTH + 1


@njit
def holds_mean(record: NDArray[np.float32], tile_row: int, tile_column: int) -> bool:
    """Whether a Gaussian's projected mean lies in a tile."""
    x, y = record[MEAN_X] - np.float32(tile_column * TILE_WIDTH), record[MEAN_Y] - np.float32(tile_row * TILE_HEIGHT)
    return x >= ZERO and x < np.float32(TILE_WIDTH) and y >= ZERO and y < np.float32(TILE_HEIGHT)


@njit(fastmath=False)
def box_tiles(record: NDArray[np.float32], width: int, height: int) -> int:
    """Number of tiles that the box around the ellipse meets: at least as many as the ellipse."""
    left = max(math.ceil(record[MEAN_X] - record[HALF_WIDTH] - HALF - SLACK), 0)
    right = min(math.floor(record[MEAN_X] + record[HALF_WIDTH] - HALF + SLACK), width - 1)
    first, last = tile_rows(record, height)
    if not left <= right:
        return 0
    return (last - first) * (int(right) // TILE_WIDTH - int(left) // TILE_WIDTH + 1)
