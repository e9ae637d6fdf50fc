"""The kernels of sphere fits: one sphere per iteration, each on its own points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import kernel, njit, prange
from .cells import Table, buffer_size, gather

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

WIDE, NARROW, NARROWING = 0.3, 0.1, 6
"""Radii off the surface at which the weight of a point falls, at first and after this many rounds."""


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
        near = np.empty(buffer_size(limit), np.int64)
        found = gather(table, starts[c], reaches[c], limit, near)
        points, sphere = np.empty((6, found)), np.empty(4)
        for k in range(found):
            for axis in range(3):
                points[axis, k], points[3 + axis, k] = table[0][near[k], axis], normals[near[k], axis]
        sphere[:3], sphere[3] = starts[c], start_radii[c]
        variance = refine(points, sphere, prior, prior_sd, rounds)
        centers[c], radii[c], radius_sds[c] = sphere[:3], sphere[3], np.sqrt(variance)


@njit
def refine(near: FloatArray, sphere: FloatArray, prior: float, prior_sd: float, rounds: int) -> float:
    """Move a sphere (4,), centre and radius, by Gauss-Newton with redescending weights.

    near: (6, K) coordinates of the points, then of their normals. Returns the variance of the radius.
    """
    x, y, z, nx, ny, nz = near[0], near[1], near[2], near[3], near[4], near[5]
    normal, gradient = np.empty((4, 4)), np.empty(4)
    for step in range(rounds):
        cx, cy, cz, radius = sphere[0], sphere[1], sphere[2], sphere[3]
        width = (WIDE - (WIDE - NARROW) * min(step / NARROWING, 1.0)) * radius
        total, ex, ey, ez, e = 0.0, 0.0, 0.0, 0.0, 0.0
        xx, yx, yy, zx, zy, zz, rx, ry, rz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(len(x)):  # without branches or arrays: several points per instruction
            dx, dy, dz = x[k] - cx, y[k] - cy, z[k] - cz
            distance = max(np.sqrt(dx * dx + dy * dy + dz * dz), 1e-12)
            dx, dy, dz = dx / distance, dy / distance, dz / distance
            facing = dx * nx[k] + dy * ny[k] + dz * nz[k]
            error = distance - radius
            fall = 1.0 + (error / width) ** 2
            weight = min(max(facing, 0.0), 1.0) / (fall * fall)
            wx, wy, wz = weight * dx, weight * dy, weight * dz
            total += weight
            ex, ey, ez, e = ex + wx * error, ey + wy * error, ez + wz * error, e + weight * error
            xx, yx, yy = xx + wx * dx, yx + wy * dx, yy + wy * dy
            zx, zy, zz = zx + wz * dx, zy + wz * dy, zz + wz * dz
            rx, ry, rz = rx + wx, ry + wy, rz + wz
        gradient[0], gradient[1], gradient[2], gradient[3] = ex, ey, ez, e
        normal[0, 0], normal[1, 0], normal[1, 1] = xx, yx, yy
        normal[2, 0], normal[2, 1], normal[2, 2] = zx, zy, zz
        normal[3, 0], normal[3, 1], normal[3, 2], normal[3, 3] = rx, ry, rz, total
        # Points of one Gaussian move together, so a neighbourhood counts as at most some tens of independent points.
        share = min(len(x), 40.0) / max(total, 1e-9) / width**2
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
        near = np.empty(buffer_size(limit), np.int64)
        found = gather(table, centers[c], reaches[c], limit, near)
        weigh(
            table[0], table[6], normals, near[:found], centers[c], radii[c],
            shell, core, facing, directions, evidence[c],
        )  # fmt: skip


@njit
def weigh(
    positions: FloatArray,
    turns: FloatArray,
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
    mean, spread, offset = np.zeros(3), np.zeros((3, 3)), np.empty(3)
    support, inside, at_surface, residual, agreement = 0, 0, 0, 0.0, 0.0
    on, first, turn = np.empty((len(near), 3)), 0, 2.0
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
        on[support] = offset
        if turns[p] < turn:
            first, turn = support, turns[p]
        support += 1
        residual += abs(distance - 1.0)
        for i in range(3):
            mean[i] += offset[i]
            for j in range(3):
                spread[i, j] += offset[i] * offset[j]
    count = max(support, 1)
    mean /= count
    for i in range(3):
        for j in range(3):
            spread[i, j] = spread[i, j] / count - mean[i] * mean[j]
    evidence[0], evidence[1] = support, inside
    evidence[2] = coverage(on[:support], mean, on[first], directions) if support > 0 else 0.0
    evidence[3] = np.sqrt(max(np.linalg.eigvalsh(spread)[0], 0.0))
    evidence[4], evidence[5] = residual / count, agreement / max(at_surface, 1)


@njit
def coverage(points: FloatArray, middle: FloatArray, first: FloatArray, directions: FloatArray) -> float:
    """Share of the directions (D, 3) that are the nearest to a point (P, 3) on a sphere around the origin.

    The directions start at the mean of the points (3,) and are turned to the first of them (3,), so they rotate with
    the points.
    """
    frame = np.eye(3)
    frame[0] = middle / max(np.sqrt((middle**2).sum()), 1e-12)
    frame[1] = first - (first * frame[0]).sum() * frame[0]
    frame[1] /= max(np.sqrt((frame[1] ** 2).sum()), 1e-12)
    for i in range(3):
        frame[2, i] = frame[0, i - 2] * frame[1, i - 1] - frame[0, i - 1] * frame[1, i - 2]
    turned, covered = directions @ frame, np.zeros(len(directions), np.bool_)
    for p in range(len(points)):
        best, most = 0, -np.inf
        for d in range(len(directions)):
            along = points[p, 0] * turned[d, 0] + points[p, 1] * turned[d, 1] + points[p, 2] * turned[d, 2]
            if along > most:
                best, most = d, along
        covered[best] = True
    share: float = covered.sum() / len(directions)
    return share
