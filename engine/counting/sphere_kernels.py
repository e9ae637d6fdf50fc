"""The loops behind sphere fits, compiled: one sphere a turn, each on its own points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..compiled import kernel, njit, prange
from .cells import Table, gather

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@kernel
def fit_all(
    table: Table,
    normals: FloatArray,
    starts: FloatArray,
    reaches: FloatArray,
    start_radii: FloatArray,
    prior: float,
    prior_sd: float,
    rounds: int,
    limit: int,
    centers: FloatArray,
    radii: FloatArray,
    radius_sds: FloatArray,
) -> None:
    """Refine spheres from starts (C, 3) on the points within reaches (C,); see `sphere.fit_spheres`."""
    for c in prange(len(starts)):
        near = np.empty(limit, np.int64)
        found = gather(table, starts[c], reaches[c], near)
        sphere = np.empty(4)
        sphere[:3], sphere[3] = starts[c], start_radii[c]
        variance = refine(table[0], normals, near[:found], sphere, prior, prior_sd, rounds)
        centers[c], radii[c], radius_sds[c] = sphere[:3], sphere[3], np.sqrt(variance)


@njit
def refine(
    positions: FloatArray,
    normals: FloatArray,
    near: IntArray,
    sphere: FloatArray,
    prior: float,
    prior_sd: float,
    rounds: int,
) -> float:
    """Move a sphere (4,), centre and radius, by Gauss-Newton with redescending weights.

    Returns the variance of its radius.
    """
    normal, gradient, row = np.empty((4, 4)), np.empty(4), np.empty(4)
    for step in range(rounds):
        radius = sphere[3]
        width = (0.3 - 0.2 * min(step / 6.0, 1.0)) * radius
        normal[:], gradient[:] = 0.0, 0.0
        total = 0.0
        for p in near:
            for axis in range(3):
                row[axis] = positions[p, axis] - sphere[axis]
            distance = max(np.sqrt(row[0] ** 2 + row[1] ** 2 + row[2] ** 2), 1e-12)
            for axis in range(3):
                row[axis] /= distance
            row[3] = 1.0
            error = distance - radius
            facing = row[0] * normals[p, 0] + row[1] * normals[p, 1] + row[2] * normals[p, 2]
            if facing <= 0.0:
                continue
            weight = min(facing, 1.0) / (1.0 + (error / width) ** 2) ** 2
            total += weight
            for i in range(4):
                gradient[i] += weight * row[i] * error
                for j in range(i + 1):
                    normal[i, j] += weight * row[i] * row[j]
        # Points of one Gaussian move together, so a neighbourhood tells no more than some tens of free points would.
        share = min(len(near), 40.0) / max(total, 1e-9) / width**2
        for i in range(4):
            gradient[i] *= share
            for j in range(i + 1):
                normal[i, j] *= share
                normal[j, i] = normal[i, j]
        normal[3, 3] += 1.0 / (prior_sd * radius) ** 2
        gradient[3] -= np.log(radius / prior) / (prior_sd**2 * radius)
        for axis in range(3):
            normal[axis, axis] += 0.5 / radius**2
        covariance = np.linalg.inv(normal)
        move = covariance @ gradient
        length = np.sqrt((move**2).sum())
        move *= min(1.0, 0.3 * radius / max(length, 1e-12))
        sphere += move
        sphere[3] = max(sphere[3], 0.2 * prior)
    return covariance[3, 3]


@kernel
def weigh_all(
    table: Table,
    normals: FloatArray,
    centers: FloatArray,
    radii: FloatArray,
    reaches: FloatArray,
    limit: int,
    shell: float,
    core: float,
    facing: float,
    directions: FloatArray,
    evidence: FloatArray,
) -> None:
    """Fill evidence (C, 6): support, points inside, coverage, thinness, residual, agreement; see `sphere.Spheres`."""
    for c in prange(len(centers)):
        near = np.empty(limit, np.int64)
        found = gather(table, centers[c], reaches[c], near)
        weigh(table[0], normals, near[:found], centers[c], radii[c], shell, core, facing, directions, evidence[c])


@njit
def weigh(
    positions: FloatArray,
    normals: FloatArray,
    near: IntArray,
    center: FloatArray,
    radius: float,
    shell: float,
    core: float,
    facing: float,
    directions: FloatArray,
    evidence: FloatArray,
) -> None:
    covered = np.zeros(len(directions), np.bool_)
    mean, spread, offset = np.zeros(3), np.zeros((3, 3)), np.empty(3)
    support, inside, at_surface, residual, agreement = 0, 0, 0, 0.0, 0.0
    for p in near:
        for axis in range(3):
            offset[axis] = (positions[p, axis] - center[axis]) / radius
        distance = max(np.sqrt(offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2), 1e-12)
        inside += distance < core
        turned = offset[0] * normals[p, 0] + offset[1] * normals[p, 1] + offset[2] * normals[p, 2]
        if abs(distance - 1.0) >= shell:
            continue
        at_surface += 1
        agreement += turned / distance
        if turned <= facing * distance:
            continue
        support += 1
        residual += abs(distance - 1.0)
        best, most = 0, -2.0
        for d in range(len(directions)):
            along = offset[0] * directions[d, 0] + offset[1] * directions[d, 1] + offset[2] * directions[d, 2]
            if along > most:
                best, most = d, along
        covered[best] = True
        for i in range(3):
            mean[i] += offset[i]
            for j in range(3):
                spread[i, j] += offset[i] * offset[j]
    count = max(support, 1)
    mean /= count
    for i in range(3):
        for j in range(3):
            spread[i, j] = spread[i, j] / count - mean[i] * mean[j]
    evidence[0], evidence[1], evidence[2] = support, inside, covered.sum() / len(directions)
    evidence[3] = np.sqrt(max(np.linalg.eigvalsh(spread)[0], 0.0))
    evidence[4], evidence[5] = residual / count, agreement / max(at_surface, 1)
