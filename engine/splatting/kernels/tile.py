"""A tile's pixels while it is blended, and the ellipse of one entry of its list over the tile's rows.

A tile is one vector of LANES pixels wide and 16 rows high. C(p) = Σ c_i α_i T_i with T_i = Π_{j<i} (1 - α_j); α below
1/255 counts as 0 and above 0.99 as 0.99; a pixel stops once T < 1e-4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import njit
from ...compiled.lanes import load, store
from .records import (
    CONIC_A,
    CONIC_B,
    CONIC_C,
    HALF,
    HALF_HEIGHT,
    LOG2_255,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    ONE,
    TILE_HEIGHT,
    TILE_WIDTH,
    ZERO,
)

CHANNELS = 6
"""Planes that blending writes: red, green, blue, depth, final transmittance, last entry of the list that counted."""
TRANSMITTANCE, LAST = 4, 5

PIXELS = TILE_WIDTH * TILE_HEIGHT
LOG2_FAINTEST = -LOG2_255
MAX_ALPHA = np.float32(0.99)
LOG2_MAX_ALPHA = np.float32(math.log2(0.99))
STOP = np.float32(1e-4)
AHEAD = 6
"""Entries of a tile's list between asking the memory for a record and reading it."""


@njit
def _rows_of(records: NDArray[np.float32], at: int, top: float) -> tuple[int, int]:
    """First and last + 1 row of a tile that a Gaussian's box meets."""
    middle, half = records[at + MEAN_Y] - top, records[at + HALF_HEIGHT]
    first = max(math.floor(middle - half - HALF), ZERO)
    last = min(math.ceil(middle + half + HALF), np.float32(TILE_HEIGHT))
    return int(first), int(last)


@njit
def ellipse_over(
    records: NDArray[np.float32], at: int, xs: Any, top: float
) -> tuple[Any, Any, Any, float, float, int, int]:
    """The ellipse at `at` seen from a tile with pixel centres `xs` and upper edge `top`: dx, edge, slope, c, my, rows.

    In row y of the tile dy = y - my and log2 α = edge - slope · dy - c · dy²; it meets rows first … last - 1.
    """
    dx = xs - records[at + MEAN_X]
    edge = records[at + LOG2_OPACITY] - dx * dx * records[at + CONIC_A]
    slope = dx * records[at + CONIC_B]
    first, last = _rows_of(records, at, top)
    return dx, edge, slope, records[at + CONIC_C], records[at + MEAN_Y] - top - HALF, first, last


@njit
def copy_in(plane: NDArray[np.float32], x0: int, y0: int, tile: NDArray[np.float32], at: int) -> None:
    """Read a tile of a plane (H, W) into a flat scratch array; 0 outside the image."""
    height, width = plane.shape
    if x0 + TILE_WIDTH <= width and y0 + TILE_HEIGHT <= height:
        flat = plane.reshape(-1)
        for y in range(TILE_HEIGHT):
            store(tile, at + y * TILE_WIDTH, load(flat, (y0 + y) * width + x0))
        return
    for y in range(TILE_HEIGHT):
        for x in range(TILE_WIDTH):
            inside = y0 + y < height and x0 + x < width
            tile[at + y * TILE_WIDTH + x] = plane[y0 + y, x0 + x] if inside else ZERO


@njit
def copy_out(tile: NDArray[np.float32], at: int, x0: int, y0: int, plane: NDArray[np.float32]) -> None:
    """Write a tile from a flat scratch array to a plane (H, W)."""
    width = plane.shape[1]
    if x0 + TILE_WIDTH <= width:
        flat = plane.reshape(-1)
        for y in range(min(TILE_HEIGHT, plane.shape[0] - y0)):
            store(flat, (y0 + y) * width + x0, load(tile, at + y * TILE_WIDTH))
        return
    for y in range(min(TILE_HEIGHT, plane.shape[0] - y0)):
        for x in range(min(TILE_WIDTH, plane.shape[1] - x0)):
            plane[y0 + y, x0 + x] = tile[at + y * TILE_WIDTH + x]


@njit
def start_tile(scratch: NDArray[np.float32], x0: int, y0: int, width: int, height: int) -> int:
    """Clear a tile's sums; pixels outside the image start with T = 0. Returns the rows that are inside, as bits."""
    scratch[:] = ZERO
    for y in range(min(TILE_HEIGHT, height - y0)):
        for x in range(min(TILE_WIDTH, width - x0)):
            scratch[TRANSMITTANCE * PIXELS + y * TILE_WIDTH + x] = ONE
    return (1 << min(TILE_HEIGHT, height - y0)) - 1
