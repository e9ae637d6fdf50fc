"""Points sorted into cubic cells, in which neighbours are found in about the time it takes to read them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from .random_streams import even_turns

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Table = tuple[FloatArray, IntArray, IntArray, FloatArray, float, IntArray, FloatArray]
"""The arrays that kernels need to find neighbours: positions, keys, starts, corner, size, shape and turns of
`Cells`."""

MOST_CELLS = 1 << 20
"""Cells along one axis; points farther out share the outermost."""


@dataclass(frozen=True, eq=False)
class Cells:
    """P points in the order of their cells.

    positions: (P, 3) in that order; index: (P,) the original number of each; keys: (K,) of the cells with points,
    rising; starts: (K + 1,) where each cell's points begin; corner: (3,) where the cells begin; size: their side, scene
    units; shape: (3,) cells along each axis; turns: (P,) in [0, 1); when neighbours are thinned, those with lower turns
    stay.
    """

    positions: FloatArray
    index: IntArray
    keys: IntArray
    starts: IntArray
    corner: FloatArray
    size: float
    shape: IntArray
    turns: FloatArray

    @classmethod
    def of(cls, positions: FloatArray, size: float, turns: FloatArray | None = None) -> Cells:
        """Sort positions (P, 3) into cells of side `size`; points of one cell keep their order. turns: (P,), by their
        order if not given."""
        corner = positions.min(axis=0) if len(positions) else np.zeros(3)
        places = np.minimum((positions - corner) / size, MOST_CELLS - 1.0).astype(np.int64)
        shape = places.max(axis=0, initial=0) + 1
        keys = (places[:, 0] * shape[1] + places[:, 1]) * shape[2] + places[:, 2]
        index = np.argsort(keys, kind="stable")
        keys = keys[index]
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        ends = np.append(starts, len(keys))
        turns = even_turns(len(positions)) if turns is None else turns
        ordered = np.ascontiguousarray(positions[index])
        return cls(ordered, index, keys[starts], ends, corner, size, shape, np.ascontiguousarray(turns[index]))

    @property
    def table(self) -> Table:
        return self.positions, self.keys, self.starts, self.corner, self.size, self.shape, self.turns

    def numbers(self, centers: FloatArray, reaches: FloatArray) -> IntArray:
        """(C,) how many points lie within reaches (C,) of the centers (C, 3)."""
        found = np.empty(len(centers), np.int64)
        _numbers(self.table, np.ascontiguousarray(centers), reaches, found)
        return found


def keep_apart(positions: FloatArray, order: IntArray, reach: float) -> IntArray:
    """Choose which of positions (P, 3) to keep, in this order (K,), so that none lies within `reach` of one kept
    before."""
    cells = Cells.of(positions, reach)
    places = np.argsort(cells.index, kind="stable")
    chosen: IntArray = cells.index[choose_apart(cells.table, np.full(len(positions), reach), places[order], 1.0)]
    return chosen


def find_least_near(cells: Cells, numbers: IntArray, centers: FloatArray, reach: float, most: int) -> IntArray:
    """Find the least (C,) of the numbers (P,), from 0, in the order of the cells, of the points within `reach` of each
    center (C, 3), if there are fewer than `most` of them; -1 if there is none."""
    found = np.full(len(centers), -1, np.int64)
    _find_least_near(cells.table, numbers, np.ascontiguousarray(centers), reach, most, found)
    return found


@njit
def find_cell(table: Table, along: float, axis: int) -> int:
    """Find the cell along an axis that holds a coordinate; the outermost for what lies outside."""
    _, _, _, corner, size, shape, _ = table
    return int(min(max(np.floor((along - corner[axis]) / size), 0.0), shape[axis] - 1.0))


@njit
def buffer_size(limit: int) -> int:
    """Size of `near` so that about `limit` points fit, whatever their turns."""
    return int(limit + 4.0 * np.sqrt(limit))


@njit
def gather(table: Table, center: FloatArray, reach: float, limit: int, near: IntArray) -> int:
    """Write which points lie within `reach` of a center (3,) into `near` (K,) and return how many were written.

    Of more than `limit` points, about `limit` with the lowest turns are written: the choice does not depend on the
    position of the cells. Points are numbered in the order of the cells.
    """
    total = count(table, center, reach)
    return walk(table, center, reach, limit / max(total, limit), near)


@njit
def count(table: Table, center: FloatArray, reach: float) -> int:
    """How many points lie within `reach` of a center (3,)."""
    return walk(table, center, reach, 1.0, np.empty(0, np.int64))


@njit
def walk(table: Table, center: FloatArray, reach: float, share: float, near: IntArray) -> int:
    """Write the points whose turn is below `share` as `gather` does; count them all if `near` is empty."""
    positions, keys, starts, _, _, shape, turns = table
    space, written = len(near), 0
    z0, z1 = find_cell(table, center[2] - reach, 2), find_cell(table, center[2] + reach, 2)
    for x in range(find_cell(table, center[0] - reach, 0), find_cell(table, center[0] + reach, 0) + 1):
        for y in range(find_cell(table, center[1] - reach, 1), find_cell(table, center[1] + reach, 1) + 1):
            row = (x * shape[1] + y) * shape[2]
            first = np.searchsorted(keys, row + z0)
            last = first
            while last < len(keys) and keys[last] <= row + z1:
                last += 1
            for p in range(starts[first], starts[last]):
                dx, dy, dz = (
                    positions[p, 0] - center[0],
                    positions[p, 1] - center[1],
                    positions[p, 2] - center[2],
                )
                if dx * dx + dy * dy + dz * dz > reach * reach or turns[p] >= share:
                    continue
                if written < space:
                    near[written] = p
                written += 1
    return min(written, space) if space > 0 else written


@njit
def choose_apart(table: Table, radii: FloatArray, order: IntArray, share: float) -> IntArray:
    """Choose, in this order, the spheres that differ by `share` of their radius or more, in centre or radius, from all
    chosen before; table: of the centres, radii: (C,) in the order of the cells."""
    centers = table[0]
    taken, near = np.zeros(len(radii), np.bool_), np.empty(len(radii), np.int64)
    kept = np.empty(len(order), np.int64)
    number = 0
    for c in order:
        if taken[c]:
            continue
        kept[number] = c
        number += 1
        reach = share * radii[c]
        for k in range(walk(table, centers[c], reach, 1.0, near)):
            taken[near[k]] |= abs(radii[near[k]] - radii[c]) < reach
    return kept[:number]


@njit
def link_points(table: Table, reach: float, near: float) -> IntArray:
    """Find the first point of the cluster of each point (P,).

    Points within `reach` of each other are linked; one within `near` of a point that searched for neighbours does not
    search itself.
    """
    positions, keys, starts, _, _, shape, _ = table
    parents, answered = np.arange(len(positions)), np.zeros(len(positions), np.bool_)
    for p in range(len(positions)):
        if answered[p]:
            continue
        px, py, pz, root = positions[p, 0], positions[p, 1], positions[p, 2], _root(parents, p)
        z0, z1 = find_cell(table, pz - reach, 2), find_cell(table, pz + reach, 2)
        for x in range(find_cell(table, px - reach, 0), find_cell(table, px + reach, 0) + 1):
            for y in range(find_cell(table, py - reach, 1), find_cell(table, py + reach, 1) + 1):
                row = (x * shape[1] + y) * shape[2]
                cell = np.searchsorted(keys, row + z0)
                while cell < len(keys) and keys[cell] <= row + z1:
                    for q in range(starts[cell], starts[cell + 1]):
                        dx, dy, dz = positions[q, 0] - px, positions[q, 1] - py, positions[q, 2] - pz
                        square = dx * dx + dy * dy + dz * dz
                        if square <= reach * reach:
                            answered[q] |= square <= near * near
                            if parents[q] != root:  # most are joined already, and this lookup takes longest
                                root = _join(parents, root, q)
                    cell += 1
    for p in range(len(positions)):
        parents[p] = _root(parents, p)
    return parents


@njit
def _root(parents: IntArray, p: int) -> int:
    while parents[p] != p:
        parents[p] = parents[parents[p]]
        p = parents[p]
    return p


@njit
def _join(parents: IntArray, p: int, q: int) -> int:
    """Join the clusters of p and q; returns its first point."""
    first, second = _root(parents, p), _root(parents, q)
    parents[max(first, second)] = min(first, second)
    return min(first, second)


@kernel
def _numbers(table: Table, centers: FloatArray, reaches: FloatArray, found: IntArray) -> None:
    for c in prange(len(centers)):
        found[c] = count(table, centers[c], reaches[c])


@kernel
def _find_least_near(
    table: Table, numbers: IntArray, centers: FloatArray, reach: float, most: int, found: IntArray
) -> None:
    for c in prange(len(centers)):
        near = np.empty(most, np.int64)
        number = walk(table, centers[c], reach, 1.0, near)
        if number > 0:
            found[c] = numbers[near[:number]].min()
