"""Vectors of masks averaged into Gaussians by how much of each mask a Gaussian covers, one Gaussian at a time.

For each Gaussian the contribution of every view, their mean and their agreement are computed together.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...compiled.blocks import next_block
from ...compiled.jit import kernel, njit, prange
from ...compiled.lanes import LANES, fill, load, store, total

ZERO, ONE, TINY = np.float32(0), np.float32(1), np.float32(1e-20)
NEAREST = np.float32(1e-2)
"""Lower bound of the distance between unit vectors when views are weighted, because the mean may coincide with a
view."""


@njit
def _dot(a: NDArray[np.float32], at: int, b: NDArray[np.float32], bt: int, length: int) -> float:
    sums = fill(ZERO)
    for d in range(0, length, LANES):
        sums = sums + load(a, at + d) * load(b, bt + d)
    return total(sums)


@njit
def _scale(values: NDArray[np.float32], at: int, length: int, factor: float) -> None:
    for d in range(0, length, LANES):
        store(values, at + d, load(values, at + d) * factor)


@njit
def _add(values: NDArray[np.float32], at: int, more: NDArray[np.float32], mt: int, length: int, factor: float) -> None:
    for d in range(0, length, LANES):
        store(values, at + d, load(values, at + d) + load(more, mt + d) * factor)


@njit
def _say(
    first: int,
    last: int,
    cells: NDArray[np.int32],
    weights: NDArray[np.float32],
    view_of: NDArray[np.int32],
    row_of: NDArray[np.int32],
    vectors: NDArray[np.float32],
    length: int,
    says: NDArray[np.float32],
    drew: NDArray[np.float32],
    sure: NDArray[np.float32],
) -> int:
    """The contribution of each view to one Gaussian: says (V · D) unit vectors, drew (V,) Σ w, sure (V,) |Σ w·v|.
    Returns V."""
    views, latest = 0, -1
    for entry in range(first, last):
        row = row_of[cells[entry]]
        if row < 0:
            continue
        if view_of[cells[entry]] != latest:
            latest = view_of[cells[entry]]
            for d in range(views * length, (views + 1) * length, LANES):
                store(says, d, fill(ZERO))
            drew[views] = ZERO
            views += 1
        _add(says, (views - 1) * length, vectors, row * length, length, weights[entry])
        drew[views - 1] += weights[entry]
    for view in range(views):
        sure[view] = math.sqrt(_dot(says, view * length, says, view * length, length))
        _scale(says, view * length, length, ONE / (sure[view] + TINY))
    return views


@njit
def _mean(
    views: int, says: NDArray[np.float32], shares: NDArray[np.float32], length: int, out: NDArray[np.float32]
) -> None:
    """out (D,): Σ shares · says, normalised."""
    for d in range(0, length, LANES):
        store(out, d, fill(ZERO))
    for view in range(views):
        _add(out, 0, says, view * length, length, shares[view])
    _scale(out, 0, length, ONE / (math.sqrt(_dot(out, 0, out, 0, length)) + TINY))


@kernel
def mix(
    workers: int,
    begin: int,
    starts: NDArray[np.int64],
    cells: NDArray[np.int32],
    weights: NDArray[np.float32],
    view_of: NDArray[np.int32],
    row_of: NDArray[np.int32],
    vectors: NDArray[np.float32],
    length: int,
    most: int,
    rounds: int,
    given: bool,
    out: NDArray[np.float32],
    drawn: NDArray[np.float32],
    agreement: NDArray[np.float32],
) -> None:
    """Fill out (n, D), drawn (n,) and agreement (n,) of the Gaussians from `begin` on.

    starts, cells, weights: a sparse (Gaussian, cell) table whose rows go from view to view; view_of, row_of: of each
    cell, the row of its vector or -1; vectors: (M · D,) flat, D = length, a multiple of LANES; most: views that a row
    can have. rounds: how often views are weighted again by their distance from the mean (Weiszfeld's steps towards the
    spherical median); 0 takes the mean by pixels. given: `out` already contains unit vectors and is not changed.
    """
    n = out.shape[0]
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        says, mean = np.empty(most * length, np.float32), np.empty(length, np.float32)
        drew, sure, shares = np.empty(most, np.float32), np.empty(most, np.float32), np.empty(most, np.float32)
        first, last = next_block(counter, n)
        while first < last:
            for i in range(first, last):
                views = _say(
                    starts[begin + i], starts[begin + i + 1], cells, weights, view_of, row_of, vectors, length,
                    says, drew, sure,
                )  # fmt: skip
                if given:
                    mean[:] = out[i]
                else:
                    for view in range(views):
                        shares[view] = sure[view]
                    _mean(views, says, shares, length, mean)
                    for _round in range(rounds):
                        for view in range(views):
                            cosine = _dot(says, view * length, mean, 0, length)
                            away = math.sqrt(max(np.float32(2) - np.float32(2) * cosine, ZERO))
                            shares[view] = sure[view] / max(away, NEAREST)
                        _mean(views, says, shares, length, mean)
                    out[i] = mean
                pixels, all_sure, agreeing = ZERO, ZERO, ZERO
                for view in range(views):
                    pixels += drew[view]
                    all_sure += sure[view]
                    agreeing += sure[view] * _dot(says, view * length, mean, 0, length)
                drawn[i] = pixels
                agreement[i] = agreeing / (all_sure + TINY)
            first, last = next_block(counter, n)


@kernel
def append_view(
    workers: int,
    starts: NDArray[np.int64],
    labels: NDArray[np.int32],
    weights: NDArray[np.float32],
    offset: int,
    places: NDArray[np.int64],
    all_cells: NDArray[np.int32],
    all_weights: NDArray[np.float32],
) -> None:
    """Append the rows of a view to a table of all views; places (N,) is advanced.

    offset: the number of the view's first cell.
    """
    n = places.shape[0]
    counter = np.zeros(1, np.int64)
    for _worker in prange(workers):
        first, last = next_block(counter, n)
        while first < last:
            for i in range(first, last):
                for entry in range(starts[i], starts[i + 1]):
                    all_cells[places[i]] = labels[entry] + offset
                    all_weights[places[i]] = weights[entry]
                    places[i] += 1
            first, last = next_block(counter, n)
