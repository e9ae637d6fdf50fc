"""Blending weights summed by label: how much of every mask each Gaussian covers, used to lift features of masks.

Every tile writes the sums of its own pairs to its own part of the lists, and every Gaussian gathers its pairs in order:
no two threads write one number, and the bytes do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import next_block
from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import anywhere, at_least, at_most, both, exp2, fill, load, ramp, select, store, take
from .records import RECORD, TILE_HEIGHT, TILE_WIDTH, ZERO
from .tile import CHANNELS, LOG2_FAINTEST, MAX_ALPHA, PIXELS, STOP, TRANSMITTANCE, ellipse_over, start_tile


@njit
def _number_labels(
    labels: NDArray[np.int32], x0: int, y0: int, local: NDArray[np.int32], found: NDArray[np.int32]
) -> int:
    """Number the labels of a tile in order of appearance: local (PIXELS,) each pixel's number or -1, found their
    labels."""
    height, width = labels.shape
    count = 0
    local[:] = -1
    for y in range(min(TILE_HEIGHT, height - y0)):
        latest = -1
        for x in range(min(TILE_WIDTH, width - x0)):
            label = labels[y0 + y, x0 + x]
            if label < 0:
                continue
            if latest < 0 or found[latest] != label:
                latest = 0
                while latest < count and found[latest] != label:
                    latest += 1
                if latest == count:
                    found[count] = label
                    count += 1
            local[y * TILE_WIDTH + x] = latest
    return count


@kernel
def count_labels(columns: int, labels: NDArray[np.int32], counts: NDArray[np.int64]) -> None:
    """counts (tiles,): how many labels each tile of labels (H, W) holds; -1 is none."""
    for tile in prange(counts.shape[0]):
        local, found = np.empty(PIXELS, np.int32), np.empty(PIXELS, np.int32)
        x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
        counts[tile] = _number_labels(labels, x0, y0, local, found)


@njit
def _label_tile(
    tile: int,
    columns: int,
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    labels: NDArray[np.int32],
    place: int,
    scratch: NDArray[np.float32],
    weights: NDArray[np.float32],
    sums: NDArray[np.float32],
    numbers: NDArray[np.int32],
    pair_starts: NDArray[np.int64],
    pair_counts: NDArray[np.int32],
    pair_labels: NDArray[np.int32],
    pair_sums: NDArray[np.float32],
) -> None:
    height, width = labels.shape
    x0, y0 = (tile % columns) * TILE_WIDTH, (tile // columns) * TILE_HEIGHT
    local, found, touched = numbers[:PIXELS], numbers[PIXELS : 2 * PIXELS], numbers[2 * PIXELS :]
    _number_labels(labels, x0, y0, local, found)
    alive = start_tile(scratch, x0, y0, width, height)
    xs = ramp() + np.float32(x0 + 0.5)
    top = np.float32(y0)
    for entry in range(tile_starts[tile], tile_starts[tile + 1]):
        pair = pair_of[entry]
        pair_counts[pair] = 0
        if alive == 0:
            continue
        _, edge, slope, c, my, first, last = ellipse_over(records, gaussian_of[entry] * RECORD, xs, top)
        many = 0
        for y in range(first, last):
            if not (alive >> y) & 1:
                continue
            dy = np.float32(y) - my
            power = edge - slope * dy - c * dy * dy
            transmittance = load(scratch, TRANSMITTANCE * PIXELS + y * TILE_WIDTH)
            counts = both(at_least(power, LOG2_FAINTEST), at_least(transmittance, STOP))
            if not anywhere(counts):
                continue
            alpha = select(counts, at_most(exp2(power), MAX_ALPHA), fill(ZERO))
            weight = alpha * transmittance
            store(weights, 0, weight)
            transmittance = transmittance - weight
            store(scratch, TRANSMITTANCE * PIXELS + y * TILE_WIDTH, transmittance)
            if not anywhere(at_least(transmittance, STOP)):
                alive &= ~(1 << y)
            for x in range(TILE_WIDTH):
                number = local[y * TILE_WIDTH + x]
                if number >= 0 and weights[x] > ZERO:
                    if sums[number] == ZERO:
                        touched[many] = number
                        many += 1
                    sums[number] += weights[x]
        pair_starts[pair] = place
        pair_counts[pair] = many
        for k in range(many):
            pair_labels[place] = found[touched[k]]
            pair_sums[place] = sums[touched[k]]
            sums[touched[k]] = ZERO
            place += 1


@kernel
def sum_labels(
    workers: int,
    columns: int,
    order: NDArray[np.int64],
    records: NDArray[np.float32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
    labels: NDArray[np.int32],
    places: NDArray[np.int64],
    pair_starts: NDArray[np.int64],
    pair_counts: NDArray[np.int32],
    pair_labels: NDArray[np.int32],
    pair_sums: NDArray[np.float32],
) -> None:
    """For every pair, the labels (H, W) it covers and Σ weight over the pixels of each.

    places: (tiles,) where each tile's part of pair_labels and pair_sums (K,) begins, with room for its list times its
    labels. Pair p has pair_counts[p] entries from pair_starts[p] on, both (P,).
    """
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        scratch = np.empty(CHANNELS * PIXELS, np.float32)
        weights, sums = np.empty(TILE_WIDTH, np.float32), np.zeros(PIXELS, np.float32)
        numbers = np.empty(3 * PIXELS, np.int32)
        while True:
            turn = take(counter)
            if turn >= order.shape[0]:
                break
            tile = order[turn]
            _label_tile(
                tile, columns, records, tile_starts, gaussian_of, pair_of, labels, places[tile], scratch, weights,
                sums, numbers, pair_starts, pair_counts, pair_labels, pair_sums,
            )  # fmt: skip


@kernel
def gather_labels(
    workers: int,
    highest: int,
    starts: NDArray[np.int64],
    counts: NDArray[np.int32],
    pair_starts: NDArray[np.int64],
    pair_counts: NDArray[np.int32],
    pair_labels: NDArray[np.int32],
    pair_sums: NDArray[np.float32],
    out_starts: NDArray[np.int64],
    out_labels: NDArray[np.int32],
    out_sums: NDArray[np.float32],
) -> None:
    """Sum the pairs' entries by Gaussian: those of Gaussian i go to out_starts[i] … out_starts[i + 1] - 1.

    Labels lie below `highest`; starts, counts: of each Gaussian's pairs. If out_labels is empty, only the numbers of
    entries are written, to out_starts[1:].
    """
    n = counts.shape[0]
    counter = np.zeros(1, np.int64)
    writes = out_labels.shape[0] > 0
    for _worker in prange(workers):
        slot_of = np.full(highest, -1, np.int64)
        listed = np.empty(highest, np.int32)
        begin, end = next_block(counter, n)
        while begin < end:
            for i in range(begin, end):
                many = 0
                for pair in range(starts[i], starts[i] + counts[i]):
                    for entry in range(pair_starts[pair], pair_starts[pair] + pair_counts[pair]):
                        label = pair_labels[entry]
                        slot = slot_of[label]
                        if slot < 0:
                            slot = many
                            slot_of[label] = slot
                            listed[slot] = label
                            many += 1
                            if writes:
                                out_labels[out_starts[i] + slot] = label
                                out_sums[out_starts[i] + slot] = ZERO
                        if writes:
                            out_sums[out_starts[i] + slot] += pair_sums[entry]
                for slot in range(many):
                    slot_of[listed[slot]] = -1
                if not writes:
                    out_starts[i + 1] = many
            begin, end = next_block(counter, n)
