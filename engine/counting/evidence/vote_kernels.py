"""The kernels of normals and of votes for centres."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, prange
from ..geometry.cells import Table, buffer_size, gather

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_FLAT = 8
"""Neighbours needed for a normal from their scatter."""
MOST_VOTES = 256
"""Points needed for a mean."""
FLAT = 0.5
"""A scatter is flat if its least variance is below this share of the next one."""


@kernel
def turn_normals(
    table: Table, normals: FloatArray, directions: FloatArray, reach: float, limit: int, turned: FloatArray
) -> None:
    """See `candidates.SurfaceIndex`: fills turned (P, 3) from normals (P, 3) and directions (P, 3) to the cameras."""
    positions = table[0]
    for p in prange(len(positions)):
        near = np.empty(buffer_size(limit), np.int64)
        found = gather(table, positions[p], reach, limit, near)
        turned[p] = normals[p]
        if found < LEAST_FLAT:
            continue
        mean, scatter = np.zeros(3), np.zeros((3, 3))
        for k in range(found):
            for i in range(3):
                mean[i] += positions[near[k], i] / found
        for k in range(found):
            for i in range(3):
                for j in range(i + 1):
                    scatter[i, j] += (positions[near[k], i] - mean[i]) * (positions[near[k], j] - mean[j])
        values, axes = np.linalg.eigh(scatter)
        if values[0] >= FLAT * values[1]:
            continue
        to_camera, with_own = 0.0, 0.0
        for i in range(3):
            to_camera += axes[i, 0] * directions[p, i]
            with_own += axes[i, 0] * normals[p, i]
        if to_camera < 0.0:
            with_own = -with_own
        if with_own <= 0.0:  # the scatter shows that the axis of the Gaussian points into the fruit
            turned[p] = 0.0
        for i in range(3):
            turned[p, i] += axes[i, 0] if to_camera >= 0.0 else -axes[i, 0]
        turned[p] /= max(np.sqrt((turned[p] ** 2).sum()), 1e-12)


# Strict arithmetic: with reordered sums, the process that compiled it and one that loads it from the cache differed.
@kernel(fastmath=False)
def average_points(table: Table, centers: FloatArray, reach: float, found: FloatArray) -> None:
    """Fill found with the mean (C, 3) of the points within `reach` of each center (C, 3); each has at least one."""
    positions = table[0]
    for c in prange(len(centers)):
        near = np.empty(buffer_size(MOST_VOTES), np.int64)
        count = gather(table, centers[c], reach, MOST_VOTES, near)
        for axis in range(3):
            total = 0.0
            for k in range(count):
                total += positions[near[k], axis]
            found[c, axis] = total / count
