"""The kernels of ellipsoid fits: one fruit per iteration, each on its own points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from .cells import Table, buffer_size, count, walk

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

WIDTH = 0.15
"""Radii off the surface at which a point's weight has fallen to a quarter."""
TILT = 0.3
"""Deviation of the normals, radians."""
TURNED = 0.5
"""Tilt at which a normal's weight has fallen to a quarter."""
INDEPENDENT = 60.0
"""Points of one Gaussian move together: those of a fruit count as at most this many independent ones."""
LONGEST_STEP = 0.3


@kernel
def fit_all(
    table: Table,
    normals: FloatArray,
    owners: IntArray,
    centers: FloatArray,
    radii: FloatArray,
    chosen: IntArray,
    reach: float,
    limit: int,
    hold: FloatArray,
    rounds: int,
    found: FloatArray,
    covariances: FloatArray,
) -> None:
    """Fit an ellipsoid to the points of each of the chosen (K,) spheres.

    Points within `reach` radii count if the sphere or no sphere owns them, at most `limit`. An ellipsoid is |S (x − c)|
    = 1, S symmetric, lengths in radii of its sphere: found (K, 9) is how far c and the six numbers of S − 1 (xx, yy,
    zz, xy, xz, yz) differ from those of the sphere, `hold` (9, 9) the inverse of their prior covariance, covariances
    (K, 9, 9) the posterior ones.
    """
    positions, turns = table[0], table[6]
    for k in prange(len(chosen)):
        f = chosen[k]
        near = np.empty(count(table, centers[f], reach * radii[f]), np.int64)
        own = 0
        for p in near[: walk(table, centers[f], reach * radii[f], 1.0, near)]:
            if owners[p] == f or owners[p] < 0:
                near[own] = p
                own += 1
        offsets, faces = np.empty((buffer_size(limit), 3)), np.empty((buffer_size(limit), 3))
        total = 0
        for p in near[:own]:
            if turns[p] * own < limit and total < len(offsets):
                for i in range(3):
                    offsets[total, i] = (positions[p, i] - centers[f, i]) / radii[f]
                    faces[total, i] = normals[p, i]
                total += 1
        fit(offsets[:total], faces[:total], hold, rounds, found[k], covariances[k])


@njit
def fit(
    points: FloatArray, normals: FloatArray, hold: FloatArray, rounds: int, found: FloatArray, covariance: FloatArray
) -> None:
    """Gauss-Newton with redescending weights on distances and on normals; see `fit_all`."""
    shape, row, step = np.eye(3), np.empty(9), np.zeros(9)
    matrix, gradient = np.empty((9, 9)), np.empty(9)
    offset, image, slope, outward = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    derivative = np.empty((3, 9))
    found[:] = 0.0
    for _ in range(rounds):
        matrix[:], gradient[:] = 0.0, 0.0
        total = 0.0
        for p in range(len(points)):
            for i in range(3):
                offset[i] = points[p, i] - found[i]
            for i in range(3):
                image[i] = shape[i, 0] * offset[0] + shape[i, 1] * offset[1] + shape[i, 2] * offset[2]
            reach = max(np.sqrt(image[0] ** 2 + image[1] ** 2 + image[2] ** 2), 1e-9)
            for i in range(3):
                slope[i] = shape[i, 0] * image[0] + shape[i, 1] * image[1] + shape[i, 2] * image[2]
            steep = max(np.sqrt(slope[0] ** 2 + slope[1] ** 2 + slope[2] ** 2), 1e-9)
            facing = 0.0
            for i in range(3):
                outward[i] = slope[i] / steep
                facing += outward[i] * normals[p, i]
            if facing <= 0.0:
                continue
            scale = reach / steep  # of |S x| − 1 to the distance from the surface, in first order
            error = (reach - 1.0) * scale
            weight = min(facing, 1.0) / (1.0 + (error / WIDTH) ** 2) ** 2
            total += weight
            shape_row(image, offset, row)
            for i in range(9):
                row[i] *= scale / reach
            for i in range(3):
                row[i] = -outward[i]
            add(matrix, gradient, row, error, 2.0 * weight / WIDTH**2)
            # The normal of the ellipsoid at the point is along S S x, here slope.
            tilt = 0.0
            for i in range(3):
                tilt += (normals[p, i] - facing * outward[i]) ** 2
            weight /= TILT**2 * (1.0 + tilt / TURNED**2) ** 2
            slope_rows(shape, image, offset, derivative)
            for j in range(9):
                along = outward[0] * derivative[0, j] + outward[1] * derivative[1, j] + outward[2] * derivative[2, j]
                for i in range(3):
                    derivative[i, j] = (derivative[i, j] - along * outward[i]) / steep
            for i in range(3):
                add(matrix, gradient, derivative[i], facing * outward[i] - normals[p, i], weight)
        share = min(total, INDEPENDENT) / max(total, 1e-9)
        for i in range(9):
            gradient[i] *= share
            for j in range(i + 1):
                matrix[i, j] *= share
                matrix[j, i] = matrix[i, j]
        gradient += hold @ found
        covariance[:] = np.linalg.inv(matrix + hold)
        step[:] = -(covariance @ gradient)
        found += step * min(1.0, LONGEST_STEP / max(np.abs(step).max(), 1e-12))
        for i in range(3):
            shape[i, i] = 1.0 + found[3 + i]
        shape[0, 1] = shape[1, 0] = found[6]
        shape[0, 2] = shape[2, 0] = found[7]
        shape[1, 2] = shape[2, 1] = found[8]


@njit
def shape_row(image: FloatArray, offset: FloatArray, row: FloatArray) -> None:
    """Derivative of |S x|²/2 with respect to the six numbers of S, into row[3:]; image: S x."""
    for i in range(3):
        row[3 + i] = image[i] * offset[i]
    row[6] = image[0] * offset[1] + image[1] * offset[0]
    row[7] = image[0] * offset[2] + image[2] * offset[0]
    row[8] = image[1] * offset[2] + image[2] * offset[1]


@njit
def slope_rows(shape: FloatArray, image: FloatArray, offset: FloatArray, derivative: FloatArray) -> None:
    """Derivative (3, 9) of S S x with respect to the centre and the six numbers of S; image: S x."""
    for i in range(3):
        for j in range(3):
            derivative[i, j] = -(shape[i, 0] * shape[0, j] + shape[i, 1] * shape[1, j] + shape[i, 2] * shape[2, j])
            # d/dS_jj: S E x + E S x with E = e_j e_jᵀ
            derivative[i, 3 + j] = shape[i, j] * offset[j]
        derivative[i, 3 + i] += image[i]
        derivative[i, 6] = shape[i, 0] * offset[1] + shape[i, 1] * offset[0]
        derivative[i, 7] = shape[i, 0] * offset[2] + shape[i, 2] * offset[0]
        derivative[i, 8] = shape[i, 1] * offset[2] + shape[i, 2] * offset[1]
    derivative[0, 6] += image[1]
    derivative[1, 6] += image[0]
    derivative[0, 7] += image[2]
    derivative[2, 7] += image[0]
    derivative[1, 8] += image[2]
    derivative[2, 8] += image[1]


@njit
def add(matrix: FloatArray, gradient: FloatArray, row: FloatArray, error: float, weight: float) -> None:
    """Add the square of a row and its product with the error; only the lower half of the matrix."""
    for i in range(9):
        gradient[i] += weight * row[i] * error
        for j in range(i + 1):
            matrix[i, j] += weight * row[i] * row[j]
