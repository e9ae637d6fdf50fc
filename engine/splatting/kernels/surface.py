"""The front surface of a pixel: the depth at which half of the light has been stopped."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import anywhere, at_least, at_most, both, exp2, fill, load, ramp, select, store, take
from .records import DEPTH, HALF, RECORD, TILE_HEIGHT, TILE_WIDTH, ZERO
from .tile import LOG2_FAINTEST, MAX_ALPHA, PIXELS, TRANSMITTANCE, copy_out, ellipse_over, start_tile

NOTHING = np.float32(1e30)
"""Depth of a pixel without a surface. Kernels compute with finite numbers only."""


@njit
def _surface_tile(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    scratch: NDArray[np.float32],
    depths: NDArray[np.float32],
) -> None:
    """Scratch: depth at 0, transmittance at TRANSMITTANCE."""
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    alive = start_tile(scratch, x0, y0, depths.shape[1], depths.shape[0])
    scratch[:PIXELS] = NOTHING
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    for entry in range(tile_starts[tile], tile_starts[tile + 1]):
        at = gaussian_of[entry] * RECORD
        _, edge, slope, c, my, first, last = ellipse_over(records, at, xs, top)
        depth = fill(records[at + DEPTH])
        for y in range(first, last):
            if not (alive >> y) & 1:
                continue
            place = y * TILE_WIDTH
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            before = load(scratch, TRANSMITTANCE * PIXELS + place)
            counts = both(at_least(power, LOG2_FAINTEST), at_least(before, HALF))
            if not anywhere(counts):
                continue
            after = before - before * select(counts, at_most(exp2(power), MAX_ALPHA), fill(ZERO))
            store(scratch, TRANSMITTANCE * PIXELS + place, after)
            kept = load(scratch, place)
            reached = select(at_least(before, HALF), depth, kept)
            store(scratch, place, select(at_least(after, HALF), kept, reached))
            if not anywhere(at_least(after, HALF)):
                alive &= ~(1 << y)
        if alive == 0:
            break
    copy_out(scratch, 0, x0, y0, depths)


@kernel
def measure_surface(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    depths: NDArray[np.float32],
) -> None:
    """Fill depths (H, W) with that of the Gaussian at which T falls below one half, NOTHING where none does."""
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty((TRANSMITTANCE + 1) * PIXELS, np.float32)
        while True:
            place = take(counter)
            if place >= order.shape[0]:
                break
            _surface_tile(order[place], columns, records, tile_starts, gaussian_of, scratch, depths)
