"""Gradient of blending, back to front from the final transmittance: one scalar represents everything behind."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import BLOCK
from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import (
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
from .project_backward import MOMENT
from .records import BLUE, CONIC_A, CONIC_B, DEPTH, GREEN, ONE, RECORD, RED, TILE_HEIGHT, TILE_WIDTH, TWO, ZERO
from .tile import AHEAD, LAST, LOG2_FAINTEST, LOG2_MAX_ALPHA, MAX_ALPHA, PIXELS, TRANSMITTANCE, copy_in, ellipse_over


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
    with_mean_gradients: bool,
    features_push: bool,
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
        dx, edge, slope, c, my, first, last = ellipse_over(records, at, xs, top)
        red, green, blue, depth = records[at + RED], records[at + GREEN], records[at + BLUE], records[at + DEPTH]
        number = np.float32(entry - begin)
        b, steep = records[at + CONIC_B], dx * (TWO * records[at + CONIC_A])
        m0 = m1 = m2 = sum_x = sum_y = sum_red = sum_green = sum_blue = sum_depth = fill(ZERO)
        for y in range(first, last):
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            place = y * TILE_WIDTH
            counts = both(at_least(power, LOG2_FAINTEST), at_least(load(scratch, LAST * PIXELS + place), number))
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
            for channel in range(extra if features_push else 0):
                here = here + load(scratch, (7 + channel) * PIXELS + place) * features[gaussian_of[entry], channel]
            behind = load(scratch, 6 * PIXELS + place)
            change = here - behind
            store(scratch, 6 * PIXELS + place, behind + alpha * change)
            v = select(at_least(power, LOG2_MAX_ALPHA), fill(ZERO), weight * change)
            m0 = m0 + v
            if with_mean_gradients:
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
    with_mean_gradients: bool,
    features_push: bool,
    moments: NDArray[np.float32],
    feature_moments: NDArray[np.float32],
) -> None:
    """Fill moments (P, MOMENT) and feature_moments (P, C): every pair's gradients, summed over its tile.

    planes: (CHANNELS + C, H, W) what `blend` wrote; gradients: (5 + C, H, W) of r, g, b, depth, alpha, features, where
    the colour is the one over `background` (3,). with_depth: whether the gradient of the depth is not 0;
    with_mean_gradients: whether to compute the absolute gradients of the means, which are 0 otherwise; features_push:
    whether the gradient of the features reaches the Gaussians that blend them, or only the features.
    """
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty((7 + features.shape[1]) * PIXELS, np.float32)
        weights = np.empty(PIXELS, np.float32)
        while True:
            place = take(counter)
            if place >= order.shape[0]:
                break
            _blend_tile_backward(
                order[place], columns, records, features, tile_starts, gaussian_of, pair_of,
                background, planes, gradients, with_depth, with_mean_gradients, features_push, scratch, weights,
                moments, feature_moments,
            )  # fmt: skip


@kernel
def sum_pairs(
    starts: NDArray[np.int64], counts: NDArray[np.int32], values: NDArray[np.float32], out: NDArray[np.float32]
) -> None:
    """out (N, C): sums of values (P, C) over each Gaussian's pairs, in their order."""
    n, channels = out.shape
    for block in prange((n + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min((block + 1) * BLOCK, n)):
            for channel in range(channels):
                out[i, channel] = ZERO
            for pair in range(starts[i], starts[i] + counts[i]):
                for channel in range(channels):
                    out[i, channel] += values[pair, channel]
