"""Blending tiles front to back, its gradient back to front, and sums of pixel features by blending weight.

A tile is one vector of LANES pixels wide and 16 rows high. C(p) = Σ c_i α_i T_i with T_i = Π_{j<i} (1 - α_j); α below
1/255 counts as 0 and above 0.99 as 0.99; a pixel stops once T < 1e-4.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, njit, prange
from .lanes import (
    LANES,
    anywhere,
    at_least,
    at_most,
    both,
    exp2,
    fill,
    load,
    prefetch,
    ramp,
    select,
    store,
    store_totals,
    take,
    total,
)
from .projection_kernels import (
    BLUE,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    LOG2_255,
    LOG2_OPACITY,
    MEAN_X,
    MEAN_Y,
    MOMENT,
    RECORD,
    RED,
    TILE_HEIGHT,
    TILE_WIDTH,
)

CHANNELS = 6
"""Planes that blending writes: red, green, blue, depth, final transmittance, last entry of the list that counted."""
TRANSMITTANCE, LAST = 4, 5

PIXELS = TILE_WIDTH * TILE_HEIGHT
FAINTEST = -LOG2_255
MAX_ALPHA = np.float32(0.99)
LOG2_MAX_ALPHA = np.float32(math.log2(0.99))
STOP = np.float32(1e-4)
AHEAD = 6
"""Entries of a tile's list between asking the memory for a record and reading it."""
ZERO, HALF, ONE, TWO = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
ALL_ROWS = (1 << TILE_HEIGHT) - 1


@njit
def rows_of(records: NDArray[np.float32], at: int, top: float) -> tuple[int, int]:
    """First and last + 1 row of a tile that a Gaussian's box meets."""
    middle, half = records[at + MEAN_Y] - top, records[at + HALF_HEIGHT]
    first = max(math.floor(middle - half - HALF), ZERO)
    last = min(math.ceil(middle + half + HALF), np.float32(TILE_HEIGHT))
    return int(first), int(last)


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
def _copy_out(tile: NDArray[np.float32], at: int, x0: int, y0: int, plane: NDArray[np.float32]) -> None:
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
def _start_tile(scratch: NDArray[np.float32], x0: int, y0: int, width: int, height: int) -> int:
    """Clear a tile's sums; pixels outside the image start with T = 0. Returns the rows that are inside, as bits."""
    scratch[:] = ZERO
    for y in range(min(TILE_HEIGHT, height - y0)):
        for x in range(min(TILE_WIDTH, width - x0)):
            scratch[TRANSMITTANCE * PIXELS + y * TILE_WIDTH + x] = ONE
    return (1 << min(TILE_HEIGHT, height - y0)) - 1


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
    alive = _start_tile(scratch, x0, y0, out.shape[2], out.shape[1])
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    begin, end = tile_starts[tile], tile_starts[tile + 1]
    for entry in range(begin, end):
        prefetch(records, gaussian_of[min(entry + AHEAD, end - 1)] * RECORD)
        at = gaussian_of[entry] * RECORD
        dx = xs - records[at + MEAN_X]
        edge = records[at + LOG2_OPACITY] - dx * dx * records[at + CONIC_A]
        slope = dx * records[at + CONIC_B]
        c, my = records[at + CONIC_C], records[at + MEAN_Y] - top - HALF
        red, green, blue, depth = records[at + RED], records[at + GREEN], records[at + BLUE], records[at + DEPTH]
        number = fill(np.float32(entry - begin))
        first, last = rows_of(records, at, top)
        for y in range(first, last):
            place = y * TILE_WIDTH
            if extra > 0:
                store(weights, place, fill(ZERO))
            if not (alive >> y) & 1:
                continue
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            transmittance = load(scratch, TRANSMITTANCE * PIXELS + place)
            counts = both(at_least(power, FAINTEST), at_least(transmittance, STOP))
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
        _copy_out(scratch, channel * PIXELS, x0, y0, out[channel])


@njit
def _blend_worker(
    counter: NDArray[np.int64],
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    out: NDArray[np.float32],
) -> None:
    scratch = np.empty((CHANNELS + features.shape[1]) * PIXELS, np.float32)
    weights = np.empty(PIXELS, np.float32)
    while True:
        place = take(counter)
        if place >= order.shape[0]:
            break
        _blend_tile(order[place], columns, records, features, tile_starts, gaussian_of, scratch, weights, out)


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

    Tiles are handed out one at a time in `order`; each writes only its own pixels, so threads change nothing.
    """
    counter = np.zeros(1, np.int64)
    for _ in prange(workers):
        _blend_worker(counter, columns, order, records, features, tile_starts, gaussian_of, out)


@njit
def _load_gradients(
    x0: int,
    y0: int,
    extra: int,
    background: NDArray[np.float32],
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    scratch: NDArray[np.float32],
) -> int:
    """Scratch: gradients of r, g, b, depth; T; last; the scalar behind; features' gradients. Returns the last entry."""
    for channel in range(4):
        copy_in(gradients[channel], x0, y0, scratch, channel * PIXELS)
    copy_in(planes[TRANSMITTANCE], x0, y0, scratch, TRANSMITTANCE * PIXELS)
    copy_in(planes[LAST], x0, y0, scratch, LAST * PIXELS)
    copy_in(gradients[4], x0, y0, scratch, 6 * PIXELS)
    for channel in range(extra):
        copy_in(gradients[5 + channel], x0, y0, scratch, (7 + channel) * PIXELS)
    deepest = ZERO
    for p in range(PIXELS):
        behind = -scratch[6 * PIXELS + p]
        for channel in range(3):
            behind += background[channel] * scratch[channel * PIXELS + p]
        scratch[6 * PIXELS + p] = behind
        deepest = max(deepest, scratch[LAST * PIXELS + p])
    return int(deepest)


@njit
def _blend_tile_backward(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    background: NDArray[np.float32],
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    with_depth: bool,
    with_pulls: bool,
    scratch: NDArray[np.float32],
    weights: NDArray[np.float32],
    moments: NDArray[np.float32],
    feature_moments: NDArray[np.float32],
) -> None:
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    extra = features.shape[1]
    deepest = _load_gradients(x0, y0, extra, background, planes, gradients, scratch)
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    flat_moments = moments.reshape(-1)
    begin, end = tile_starts[tile], tile_starts[tile + 1]
    for entry in range(min(begin + deepest + 1, end), end):
        moments[pair_of[entry]] = ZERO
        if extra > 0:
            feature_moments[pair_of[entry]] = ZERO
    for entry in range(min(begin + deepest, end - 1), begin - 1, -1):
        prefetch(records, gaussian_of[max(entry - AHEAD, begin)] * RECORD)
        prefetch(flat_moments, pair_of[max(entry - AHEAD, begin)] * MOMENT)
        at = gaussian_of[entry] * RECORD
        dx = xs - records[at + MEAN_X]
        edge = records[at + LOG2_OPACITY] - dx * dx * records[at + CONIC_A]
        slope = dx * records[at + CONIC_B]
        c, my = records[at + CONIC_C], records[at + MEAN_Y] - top - HALF
        red, green, blue, depth = records[at + RED], records[at + GREEN], records[at + BLUE], records[at + DEPTH]
        number = np.float32(entry - begin)
        b, steep = records[at + CONIC_B], dx * (TWO * records[at + CONIC_A])
        m0 = m1 = m2 = sum_x = sum_y = sum_red = sum_green = sum_blue = sum_depth = fill(ZERO)
        first, last = rows_of(records, at, top)
        for y in range(first, last):
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            place = y * TILE_WIDTH
            counts = both(at_least(power, FAINTEST), at_least(load(scratch, LAST * PIXELS + place), number))
            if not anywhere(counts):
                if extra > 0:
                    store(weights, place, fill(ZERO))
                continue
            alpha = select(counts, at_most(exp2(power), MAX_ALPHA), fill(ZERO))
            transmittance = load(scratch, TRANSMITTANCE * PIXELS + place) / (ONE - alpha)
            store(scratch, TRANSMITTANCE * PIXELS + place, transmittance)
            weight = alpha * transmittance
            d_red, d_green = load(scratch, place), load(scratch, PIXELS + place)
            d_blue = load(scratch, 2 * PIXELS + place)
            here = d_red * red + d_green * green + d_blue * blue
            if with_depth:
                d_depth = load(scratch, 3 * PIXELS + place)
                here = here + d_depth * depth
                sum_depth = sum_depth + weight * d_depth
            for channel in range(extra):
                here = here + load(scratch, (7 + channel) * PIXELS + place) * features[gaussian_of[entry], channel]
            behind = load(scratch, 6 * PIXELS + place)
            change = here - behind
            store(scratch, 6 * PIXELS + place, behind + alpha * change)
            v = select(at_least(power, LOG2_MAX_ALPHA), fill(ZERO), weight * change)
            m0 = m0 + v
            if with_pulls:
                pull_x, pull_y = v * (steep + b * dy), v * (slope + TWO * c * dy)
                sum_x = sum_x + select(at_least(pull_x, ZERO), pull_x, ZERO - pull_x)
                sum_y = sum_y + select(at_least(pull_y, ZERO), pull_y, ZERO - pull_y)
            v = v * dy
            m1 = m1 + v
            m2 = m2 + v * dy
            sum_red = sum_red + weight * d_red
            sum_green = sum_green + weight * d_green
            sum_blue = sum_blue + weight * d_blue
            if extra > 0:
                store(weights, place, weight)
        along = m0 * dx
        store_totals(
            flat_moments, pair_of[entry] * MOMENT, m0, along, m1, along * dx, m1 * dx, m2,
            sum_red, sum_green, sum_blue, sum_depth, sum_x, sum_y,
        )  # fmt: skip
        for channel in range(extra):
            collected = fill(ZERO)
            for y in range(first, last):
                place = y * TILE_WIDTH
                collected = collected + load(weights, place) * load(scratch, (7 + channel) * PIXELS + place)
            feature_moments[pair_of[entry], channel] = total(collected)


@njit
def _backward_worker(
    counter: NDArray[np.int64],
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    background: NDArray[np.float32],
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    with_depth: bool,
    with_pulls: bool,
    moments: NDArray[np.float32],
    feature_moments: NDArray[np.float32],
) -> None:
    scratch = np.empty((7 + features.shape[1]) * PIXELS, np.float32)
    weights = np.empty(PIXELS, np.float32)
    while True:
        place = take(counter)
        if place >= order.shape[0]:
            break
        _blend_tile_backward(
            order[place], columns, records, features, tile_starts, gaussian_of, pair_of,
            background, planes, gradients, with_depth, with_pulls, scratch, weights, moments, feature_moments,
        )  # fmt: skip


@kernel
def blend_backward(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    features: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    background: NDArray[np.float32],
    planes: NDArray[np.float32],
    gradients: NDArray[np.float32],
    with_depth: bool,
    with_pulls: bool,
    moments: NDArray[np.float32],
    feature_moments: NDArray[np.float32],
) -> None:
    """Fill moments (P, MOMENT) and feature_moments (P, C): every pair's gradients, summed over its tile.

    planes: (CHANNELS + C, H, W) what `blend` wrote; gradients: (5 + C, H, W) of r, g, b, depth, alpha, features, where
    the colour is the one over `background` (3,). with_depth: whether the gradient of the depth is not 0; with_pulls:
    whether the absolute gradients of the mean are wanted, which are 0 else.
    """
    counter = np.zeros(1, np.int64)
    for _ in prange(workers):
        _backward_worker(
            counter, columns, order, records, features, tile_starts, gaussian_of, pair_of,
            background, planes, gradients, with_depth, with_pulls, moments, feature_moments,
        )  # fmt: skip


@kernel
def sum_pairs(
    starts: NDArray[np.int64], counts: NDArray[np.int32], values: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """out (N, C): sums of values (P, C) over each Gaussian's pairs, in their order."""
    n, channels = out.shape
    for block in prange((n + 511) // 512):
        for i in range(block * 512, min((block + 1) * 512, n)):
            for channel in range(channels):
                out[i, channel] = ZERO
            for pair in range(starts[i], starts[i] + counts[i]):
                for channel in range(channels):
                    out[i, channel] += values[pair, channel]


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
    alive = _start_tile(scratch, x0, y0, width, height)
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
        dx = xs - records[at + MEAN_X]
        edge = records[at + LOG2_OPACITY] - dx * dx * records[at + CONIC_A]
        slope = dx * records[at + CONIC_B]
        c, my = records[at + CONIC_C], records[at + MEAN_Y] - top - HALF
        first, last = rows_of(records, at, top)
        everything = fill(ZERO)
        for y in range(first, last):
            place = y * TILE_WIDTH
            store(weights, place, fill(ZERO))
            if not (alive >> y) & 1:
                continue
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            transmittance = load(scratch, TRANSMITTANCE * PIXELS + place)
            counts = both(at_least(power, FAINTEST), at_least(transmittance, STOP))
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


@njit
def _accumulate_worker(
    counter: NDArray[np.int64],
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    target: NDArray[np.float32],
    sums: NDArray[np.float32],
) -> None:
    scratch = np.empty(CHANNELS * PIXELS, np.float32)
    weights = np.empty(PIXELS, np.float32)
    pixels = np.empty(PIXELS * ((target.shape[2] + LANES - 1) // LANES) * LANES, np.float32)
    while True:
        place = take(counter)
        if place >= order.shape[0]:
            break
        _accumulate_tile(
            order[place], columns, records, tile_starts, gaussian_of, pair_of, target, scratch, weights, pixels, sums
        )


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
    for _ in prange(workers):
        _accumulate_worker(counter, columns, order, records, tile_starts, gaussian_of, pair_of, target, sums)
