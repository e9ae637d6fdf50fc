"""Which points each sphere explains: the points that spheres compete for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from ..geometry.cells import Cells, Table, buffer_size, gather
from ..geometry.sphere import CORE, FACING, MOST_POINTS, SHELL

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

REACH = 1.35
"""Radii within which a sphere may claim a point."""
FALL = 0.35
"""The value of a point falls to 0 at this many radii from the surface."""
OFF, INSIDE = -2.0, -1.0
"""Value of points that are neither on the sphere nor well inside it, and of those well inside."""


@dataclass(frozen=True, eq=False)
class Claims:
    """points: (K,) of all spheres, one sphere after the other; worths: (K,) of each to its sphere, in 0…1 on the
    surface, INSIDE well below it; bounds: (C + 1,) where the points of each sphere begin."""

    points: IntArray
    worths: FloatArray
    bounds: IntArray

    def value(self, sphere: int, owners: IntArray) -> tuple[float, float]:
        """Summed value of the points of a sphere without an owner, and how many of them lie well inside; owners: (P,),
        -1 for none."""
        part = slice(self.bounds[sphere], self.bounds[sphere + 1])
        return _free(self.points[part], self.worths[part], owners)  # type: ignore[no-any-return]

    def take(self, sphere: int, number: int, owners: IntArray) -> None:
        """Make `number` the owner of the points of the sphere without an owner."""
        points = self.points[self.bounds[sphere] : self.bounds[sphere + 1]]
        owners[points[owners[points] < 0]] = number


def members(owners: IntArray, count: int) -> list[IntArray]:
    """The points of each of `count` owners, ascending; owners: (P,), -1 for none."""
    order = np.argsort(owners, kind="stable")
    return np.split(order, np.searchsorted(owners[order], np.arange(count + 1)))[1:-1]


def commonest(numbers: IntArray) -> int:
    """The most common of one or more numbers; the least of equally common ones."""
    values, times = np.unique(numbers, return_counts=True)
    return int(values[times.argmax()])


def claim(cells: Cells, normals: FloatArray, centers: FloatArray, radii: FloatArray) -> Claims:
    """The points that each of C spheres, centers (C, 3) and radii (C,), claims."""
    numbers = np.minimum(cells.numbers(centers, REACH * radii), buffer_size(MOST_POINTS))
    bounds = np.concatenate([np.zeros(1, np.int64), np.cumsum(numbers)])
    points, worths = np.empty(bounds[-1], np.int64), np.full(bounds[-1], OFF)
    _claim(cells.table, normals, centers, radii, bounds, points, worths)
    kept = worths > OFF
    ends = np.concatenate([np.zeros(1, np.int64), np.cumsum(kept)])
    return Claims(points[kept], worths[kept], ends[bounds])


@kernel
def _claim(
    table: Table,
    normals: FloatArray,
    centers: FloatArray,
    radii: FloatArray,
    bounds: IntArray,
    points: IntArray,
    worths: FloatArray,
) -> None:
    positions = table[0]
    for c in prange(len(radii)):
        near = points[bounds[c] : bounds[c + 1]]
        for k in range(gather(table, centers[c], REACH * radii[c], MOST_POINTS, near)):
            p = near[k]
            square, turned = 0.0, 0.0
            for axis in range(3):
                offset = (positions[p, axis] - centers[c, axis]) / radii[c]
                square += offset * offset
                turned += offset * normals[p, axis]
            distance = max(np.sqrt(square), 1e-12)
            error = abs(distance - 1.0)
            if error < SHELL and turned > FACING * distance:
                worths[bounds[c] + k] = min(max(1.0 - error / FALL, 0.0), 1.0)
            else:
                worths[bounds[c] + k] = INSIDE if distance < CORE else OFF


@njit
def _free(points: IntArray, worths: FloatArray, owners: IntArray) -> tuple[float, float]:
    value, inside = 0.0, 0.0
    for k in range(len(points)):
        if owners[points[k]] >= 0:
            continue
        if worths[k] == INSIDE:
            inside += 1.0
        else:
            value += worths[k]
    return value, inside
