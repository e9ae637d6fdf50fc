"""Which Gaussians each tile draws, nearest first."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import next_block
from ...compiled.jit import kernel, njit, prange
from .records import DEPTH, holds_mean, tile_columns, tile_rows

_BITS = 11
_BUCKETS = 1 << _BITS


@njit
def sort_by_depth(records: NDArray[np.float32], counts: NDArray[np.int32]) -> NDArray[np.int32]:
    """Sort the indices of the drawn Gaussians by depth; equal depths in the order of the indices (radix sort).

    A positive float32 sorts as the integer of the same bits: three rounds of eleven bits.
    """
    n = counts.shape[0]
    order = np.empty(n, np.int32)
    drawn = 0
    for i in range(n):
        if counts[i] > 0:
            order[drawn] = i
            drawn += 1
    order = order[:drawn]
    keys = np.empty(drawn, np.float32)
    for k in range(drawn):
        keys[k] = records[order[k], DEPTH]
    bits = keys.view(np.uint32)
    other_order = np.empty(drawn, np.int32)
    other_bits = np.empty(drawn, np.uint32)
    places = np.empty(_BUCKETS, np.int64)
    for shift in (0, _BITS, 2 * _BITS):
        places[:] = 0
        for k in range(drawn):
            places[(bits[k] >> np.uint32(shift)) & np.uint32(_BUCKETS - 1)] += 1
        place = 0
        for bucket in range(_BUCKETS):
            count = places[bucket]
            places[bucket] = place
            place += count
        for k in range(drawn):
            bucket = (bits[k] >> np.uint32(shift)) & np.uint32(_BUCKETS - 1)
            other_order[places[bucket]] = order[k]
            other_bits[places[bucket]] = bits[k]
            places[bucket] += 1
        order, other_order = other_order, order
        bits, other_bits = other_bits, bits
    return order


@njit
def pair_starts(room: NDArray[np.int32]) -> NDArray[np.int64]:
    """(N + 1,) where each Gaussian's pairs begin, and how many fit in all."""
    starts = np.empty(room.shape[0] + 1, np.int64)
    starts[0] = 0
    for i in range(room.shape[0]):
        starts[i + 1] = starts[i] + room[i]
    return starts


@kernel
def list_pairs(
    workers: int,
    records: NDArray[np.float32],
    starts: NDArray[np.int64],
    width: int,
    height: int,
    columns: int,
    literal: bool,
    tile_of: NDArray[np.int32],
    counts: NDArray[np.int32],
) -> None:
    """Write the tiles that each Gaussian's ellipse meets, row by row, into its part of tile_of; counts (N,) of them.

    literal: only the tile that holds the mean.
    """
    n = counts.shape[0]
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        begin, end = next_block(counter, n)
        while begin < end:
            for i in range(begin, end):
                pair = starts[i]
                room_end = starts[i + 1]
                if pair < room_end:
                    first, last = tile_rows(records[i], height)
                    for row in range(first, last):
                        left, right = tile_columns(records[i], row, width)
                        for column in range(left, right):
                            if pair < room_end and (not literal or holds_mean(records[i], row, column)):
                                tile_of[pair] = row * columns + column
                                pair += 1
                counts[i] = pair - starts[i]
            begin, end = next_block(counter, n)


def order_by_load(tile_starts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order tiles by the length of their lists, longest first, so that the last ones take little time (paper, eq.
    4)."""
    return np.argsort(tile_starts[:-1] - tile_starts[1:], kind="stable")


CHUNKS = 16
"""Parts of the depth order that are sorted into tiles at once; fixed, so that threads change nothing."""


@kernel
def fill_tiles(
    order: NDArray[np.int32],
    starts: NDArray[np.int64],
    counts: NDArray[np.int32],
    tile_of: NDArray[np.int32],
    tile_starts: NDArray[np.int64],
    gaussian_of: NDArray[np.int32],
    pair_of: NDArray[np.int32],
) -> None:
    """Write tile_starts (tiles + 1,) and, for each entry of each tile's list, nearest first, its Gaussian and its pair.

    Pairs stay numbered by Gaussian, so that a Gaussian's gradients lie side by side.
    """
    tiles = tile_starts.shape[0] - 1
    n = order.shape[0]
    size = (n + CHUNKS - 1) // CHUNKS
    places = np.zeros((CHUNKS, tiles), np.int64)
    for chunk in prange(CHUNKS):
        for k in range(chunk * size, min((chunk + 1) * size, n)):
            for pair in range(starts[order[k]], starts[order[k]] + counts[order[k]]):
                places[chunk, tile_of[pair]] += 1
    place = 0
    for tile in range(tiles):
        tile_starts[tile] = place
        for chunk in range(CHUNKS):
            count = places[chunk, tile]
            places[chunk, tile] = place
            place += count
    tile_starts[tiles] = place
    for chunk in prange(CHUNKS):
        for k in range(chunk * size, min((chunk + 1) * size, n)):
            for pair in range(starts[order[k]], starts[order[k]] + counts[order[k]]):
                entry = places[chunk, tile_of[pair]]
                places[chunk, tile_of[pair]] = entry + 1
                gaussian_of[entry] = order[k]
                pair_of[entry] = pair
