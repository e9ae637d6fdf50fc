"""The number of Gaussians that a pixel blends (the paper's ℓ, eq. 4), a smooth approximation of it, and its gradient.

ℓ is a count and has no gradient. The approximation counts a Gaussian as s(α) = α / (α + 1/16): nearly 1 where it
matters, falling towards 0 at its edges, where it can shrink without changing the picture.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import anywhere, at_least, at_most, both, exp2, fill, load, ramp, select, store, take, total
from .records import ONE, RECORD, TILE_HEIGHT, TILE_WIDTH, ZERO
from .tile import LAST, LOG2_FAINTEST, LOG2_MAX_ALPHA, MAX_ALPHA, PIXELS, copy_in, ellipse_over

SOFT = np.float32(1 / 16)


@njit
def _measure_tile(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    planes: NDArray[np.float32],
    scratch: NDArray[np.float32],
    loads: NDArray[np.float32],
) -> None:
    """Scratch: last entry that counted, ℓ, approximation."""
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    scratch[:] = ZERO
    copy_in(planes[LAST], x0, y0, scratch, 0)
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    begin, end = tile_starts[tile], tile_starts[tile + 1]
    for entry in range(begin, end):
        at = gaussian_of[entry] * RECORD
        _, edge, slope, c, my, first, last = ellipse_over(records, at, xs, top)
        for y in range(first, last):
            place = y * TILE_WIDTH
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            counts = both(at_least(power, LOG2_FAINTEST), at_least(load(scratch, place), np.float32(entry - begin)))
            if not anywhere(counts):
                continue
            alpha = select(counts, at_most(exp2(power), MAX_ALPHA), fill(ZERO))
            one = select(counts, fill(ONE), fill(ZERO))
            store(scratch, PIXELS + place, load(scratch, PIXELS + place) + one)
            store(scratch, 2 * PIXELS + place, load(scratch, 2 * PIXELS + place) + alpha / (alpha + SOFT))
    for y in range(min(TILE_HEIGHT, loads.shape[1] - y0)):
        for x in range(min(TILE_WIDTH, loads.shape[2] - x0)):
            loads[0, y0 + y, x0 + x] = scratch[PIXELS + y * TILE_WIDTH + x]
            loads[1, y0 + y, x0 + x] = scratch[2 * PIXELS + y * TILE_WIDTH + x]


@kernel
def measure_loads(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    planes: NDArray[np.float32],
    loads: NDArray[np.float32],
) -> None:
    """Fill loads (2, H, W): how many Gaussians each pixel blended, and the approximation. planes: written by
    `blend`."""
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty(3 * PIXELS, np.float32)
        while True:
            place = take(counter)
            if place >= order.shape[0]:
                break
            _measure_tile(order[place], columns, records, tile_starts, gaussian_of, planes, scratch, loads)


@njit
def _tile_backward(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    planes: NDArray[np.float32],
    gradient: NDArray[np.float32],
    scratch: NDArray[np.float32],
    moments: NDArray[np.float32],
) -> None:
    """Scratch: last entry that counted, gradient of the approximation."""
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    copy_in(planes[LAST], x0, y0, scratch, 0)
    copy_in(gradient, x0, y0, scratch, PIXELS)
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    begin, end = tile_starts[tile], tile_starts[tile + 1]
    for entry in range(begin, end):
        at = gaussian_of[entry] * RECORD
        dx, edge, slope, c, my, first, last = ellipse_over(records, at, xs, top)
        m0 = m1 = m2 = fill(ZERO)
        for y in range(first, last):
            place = y * TILE_WIDTH
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            counts = both(at_least(power, LOG2_FAINTEST), at_least(load(scratch, place), np.float32(entry - begin)))
            if not anywhere(counts):
                continue
            alpha = select(counts, exp2(power), fill(ZERO))
            below = alpha + SOFT
            v = load(scratch, PIXELS + place) * alpha * SOFT / (below * below)
            v = select(at_least(power, LOG2_MAX_ALPHA), fill(ZERO), v)
            m0 = m0 + v
            v = v * dy
            m1 = m1 + v
            m2 = m2 + v * dy
        pair = moments[pair_of[entry]]
        pair[0] += total(m0)
        pair[2] += total(m1)
        pair[5] += total(m2)
        m0 = m0 * dx
        pair[1] += total(m0)
        pair[3] += total(m0 * dx)
        pair[4] += total(m1 * dx)


@kernel
def loads_backward(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    planes: NDArray[np.float32],
    gradient: NDArray[np.float32],
    moments: NDArray[np.float32],
) -> None:
    """Add the contribution of the approximation's gradient (H, W) to moments (P, MOMENT), written by
    `blend_backward`."""
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty(2 * PIXELS, np.float32)
        while True:
            place = take(counter)
            if place >= order.shape[0]:
                break
            _tile_backward(
                order[place], columns, records, tile_starts, gaussian_of, pair_of, planes, gradient, scratch, moments
            )
