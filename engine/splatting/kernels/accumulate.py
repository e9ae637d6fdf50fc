"""Sums of pixel features by blending weight for every Gaussian, used to lift features of images."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import (
    LANES,
    anywhere,
    at_least,
    at_most,
    both,
    exp2,
    fill,
    load,
    ramp,
    select,
    store,
    take,
    total,
)
from .records import RECORD, TILE_HEIGHT, TILE_WIDTH, ZERO
from .tile import CHANNELS, LOG2_FAINTEST, MAX_ALPHA, PIXELS, STOP, TRANSMITTANCE, ellipse_over, start_tile


@njit
def _accumulate_tile(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    target: NDArray[np.float32],
    scratch: NDArray[np.float32],
    weights: NDArray[np.float32],
    pixels: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    height, width, channels = target.shape
    vectors = (channels + LANES - 1) // LANES
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    alive = start_tile(scratch, x0, y0, width, height)
    pixels[:] = ZERO
    for y in range(min(TILE_HEIGHT, height - y0)):
        for x in range(min(TILE_WIDTH, width - x0)):
            for channel in range(channels):
                pixels[(y * TILE_WIDTH + x) * vectors * LANES + channel] = target[y0 + y, x0 + x, channel]
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    for entry in range(tile_starts[tile], tile_starts[tile + 1]):
        at = gaussian_of[entry] * RECORD
        pair = sums[pair_of[entry]]
        pair[:] = ZERO
        if alive == 0:
            continue
        _, edge, slope, c, my, first, last = ellipse_over(records, at, xs, top)
        everything = fill(ZERO)
        for y in range(first, last):
            place = y * TILE_WIDTH
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
            everything = everything + weight
            store(weights, place, weight)
            transmittance = transmittance - weight
            store(scratch, TRANSMITTANCE * PIXELS + place, transmittance)
            if not anywhere(at_least(transmittance, STOP)):
                alive &= ~(1 << y)
        pair[vectors * LANES] = total(everything)
        for vector in range(vectors):
            collected = fill(ZERO)
            for p in range(first * TILE_WIDTH, last * TILE_WIDTH):
                if weights[p] > ZERO:
                    collected = collected + load(pixels, (p * vectors + vector) * LANES) * weights[p]
            store(pair, vector * LANES, collected)


@kernel
def accumulate_pairs(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    target: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    """Fill sums (P, ⌈D / LANES⌉ · LANES + 1): Σ weight · target over each pair's pixels, and at the end Σ weight.

    target: (H, W, D).
    """
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty(CHANNELS * PIXELS, np.float32)
        weights = np.empty(PIXELS, np.float32)
        pixels = np.empty(PIXELS * ((target.shape[2] + LANES - 1) // LANES) * LANES, np.float32)
        while True:
            place = take(counter)
            if place >= order.shape[0]:
                break
            _accumulate_tile(
                order[place], columns, records, tile_starts, gaussian_of, pair_of,
                target, scratch, weights, pixels, sums,
            )  # fmt: skip
