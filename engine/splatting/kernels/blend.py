"""Blending of tiles front to back (see `kernels.tile` for the equation)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import anywhere, at_least, at_most, both, exp2, fill, load, prefetch, ramp, select, store, take
from .records import BLUE, DEPTH, GREEN, RECORD, RED, TILE_HEIGHT, TILE_WIDTH, ZERO
from .tile import (
    AHEAD,
    CHANNELS,
    LAST,
    LOG2_FAINTEST,
    MAX_ALPHA,
    PIXELS,
    STOP,
    TRANSMITTANCE,
    copy_out,
    ellipse_over,
    start_tile,
)


@njit
def _blend_tile(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    scratch: NDArray[np.float32],
    weights: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    extra = features.shape[1]
    alive = start_tile(scratch, x0, y0, out.shape[2], out.shape[1])
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    begin, end = tile_starts[tile], tile_starts[tile + 1]
    for entry in range(begin, end):
        prefetch(records, gaussian_of[min(entry + AHEAD, end - 1)] * RECORD)
        at = gaussian_of[entry] * RECORD
        _, edge, slope, c, my, first, last = ellipse_over(records, at, xs, top)
        red, green, blue, depth = records[at + RED], records[at + GREEN], records[at + BLUE], records[at + DEPTH]
        number = fill(np.float32(entry - begin))
        for y in range(first, last):
            place = y * TILE_WIDTH
            if extra > 0:
                store(weights, place, fill(ZERO))
            if not (alive >> y) & 1:
                continue
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            transmittance = load(scratch, TRANSMITTANCE * PIXELS + place)
            counts = both(at_least(power, LOG2_FAINTEST), at_least(transmittance, STOP))
            if not anywhere(counts):
                continue
            alpha = select(counts, at_most(exp2(power), MAX_ALPHA), fill(ZERO))
            weight = alpha * transmittance
            store(scratch, place, load(scratch, place) + weight * red)
            store(scratch, PIXELS + place, load(scratch, PIXELS + place) + weight * green)
            store(scratch, 2 * PIXELS + place, load(scratch, 2 * PIXELS + place) + weight * blue)
            store(scratch, 3 * PIXELS + place, load(scratch, 3 * PIXELS + place) + weight * depth)
            transmittance = transmittance - weight
            store(scratch, TRANSMITTANCE * PIXELS + place, transmittance)
            store(scratch, LAST * PIXELS + place, select(counts, number, load(scratch, LAST * PIXELS + place)))
            if extra > 0:
                store(weights, place, weight)
            if not anywhere(at_least(transmittance, STOP)):
                alive &= ~(1 << y)
        for channel in range(extra):
            value = features[gaussian_of[entry], channel]
            for y in range(first, last):
                place = (CHANNELS + channel) * PIXELS + y * TILE_WIDTH
                store(scratch, place, load(scratch, place) + load(weights, y * TILE_WIDTH) * value)
        if alive == 0:
            break
    for channel in range(CHANNELS + extra):
        copy_out(scratch, channel * PIXELS, x0, y0, out[channel])


@kernel
def blend(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    out: NDArray[np.float32],
) -> None:
    """Fill out (CHANNELS + C, H, W) from flat records (N · RECORD,), features (N, C) and the tiles' lists.

    Tiles are scheduled one at a time in `order`; each writes only its own pixels, so the number of threads does not
    matter.
    """
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty((CHANNELS + features.shape[1]) * PIXELS, np.float32)
        weights = np.empty(PIXELS, np.float32)
        while True:
            place = take(counter)
            if place >= order.shape[0]:
                break
            _blend_tile(order[place], columns, records, features, tile_starts, gaussian_of, scratch, weights, out)
