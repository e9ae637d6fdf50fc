"""Robust sphere fits to surface points, many at once, and what speaks for each."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .sample import SurfacePoints

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

REACH = 1.6
"""Points within this many radii of a start belong to its neighbourhood."""
SHELL = 0.25
"""A point within this many radii of the surface, its normal outwards, is on the sphere."""
CORE = 0.65
"""A point nearer to the centre than this many radii speaks against the sphere."""
FACING = 0.2
"""Least cosine between a point's normal and its direction from the centre for the point to be on the sphere."""
BINS = 60
"""Directions in which the coverage of a sphere is counted."""


@dataclass(frozen=True, eq=False)
class Spheres:
    """C fitted spheres.

    centers: (C, 3), radii: (C,), radius_sds: (C,) scene units; support: (C,) number of points on the sphere;
    shell: (C,) of those and of the points well inside, the share on the sphere; coverage: (C,) share of directions in
    which the sphere has points; thinness: (C,) least standard deviation of the points on it, in radii; residual: (C,)
    mean distance of these from the surface, in radii.
    """

    centers: FloatArray
    radii: FloatArray
    radius_sds: FloatArray
    support: FloatArray
    shell: FloatArray
    coverage: FloatArray
    thinness: FloatArray
    residual: FloatArray

    def __len__(self) -> int:
        return len(self.radii)

    def grown(self, factor: float) -> Spheres:
        """The same spheres with all radii times `factor`."""
        return replace(self, radii=factor * self.radii, radius_sds=factor * self.radius_sds)

    @staticmethod
    def empty() -> Spheres:
        """No sphere."""
        return Spheres(np.zeros((0, 3)), *(np.zeros(0) for _ in range(7)))

    def select(self, index: NDArray) -> Spheres:
        """The spheres at `index` (bool mask (C,) or integer indices)."""
        return Spheres(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


def neighborhoods(tree: cKDTree, centers: FloatArray, reaches: FloatArray, limit: int) -> IntArray:
    """(C, limit) indices of tree points within reach (C,) of each centre (C, 3), evenly thinned to `limit`; -1 pads."""
    index = np.full((len(centers), limit), -1, np.int64)
    for start in range(0, len(centers), 64):  # all lists at once would fill any memory
        rows = slice(start, start + 64)
        lists = tree.query_ball_point(centers[rows], reaches[rows], return_sorted=True)
        for row, near in enumerate(lists, start):
            if len(near) > limit:
                index[row] = np.asarray(near)[np.linspace(0, len(near) - 1, limit).astype(np.int64)]
            else:
                index[row, : len(near)] = near
    return index


def fit_spheres(
    points: SurfacePoints,
    near: IntArray,
    centers: FloatArray,
    radii: FloatArray,
    *,
    prior_sd: float,
    rounds: int = 12,
) -> Spheres:
    """Refine C spheres from starts on their neighbourhoods `near` (C, K), by Gauss-Newton with redescending weights.

    centers: (C, 3), radii: (C,) starts. log r is held near the start's by a normal prior of deviation `prior_sd`: a
    half-seen cap alone leaves centre and radius tied to each other.
    """
    parts = [
        _fit_chunk(points, near[rows], centers[rows], radii[rows], prior_sd, rounds)
        for rows in (slice(start, start + 500) for start in range(0, max(len(centers), 1), 500))
    ]
    return Spheres(**{field.name: np.concatenate([getattr(p, field.name) for p in parts]) for field in fields(Spheres)})


def _fit_chunk(
    points: SurfacePoints, near: IntArray, centers: FloatArray, radii: FloatArray, prior_sd: float, rounds: int
) -> Spheres:
    positions, normals = points.positions[near], points.normals[near]
    valid = (near >= 0).astype(np.float64)
    start, centers, radii = radii, centers.copy(), radii.copy()
    covariance = np.broadcast_to(np.eye(4), (len(radii), 4, 4))
    for step in range(rounds):
        width = (0.3 - 0.2 * min(step / 6.0, 1.0)) * radii
        offset = positions - centers[:, None]
        distance = np.maximum(np.linalg.norm(offset, axis=2), 1e-12)
        outward = offset / distance[:, :, None]
        error = distance - radii[:, None]
        facing = np.clip(np.einsum("ckj,ckj->ck", normals, outward), 0.0, 1.0)
        weight = valid * facing / (1.0 + (error / width[:, None]) ** 2) ** 2
        # Points of one Gaussian move together, so a neighbourhood tells no more than some tens of free points would.
        weight *= (np.minimum(valid.sum(axis=1), 40.0) / np.maximum(weight.sum(axis=1), 1e-9))[:, None]
        jacobian = np.concatenate([outward, np.ones_like(distance)[:, :, None]], axis=2)
        normal = np.einsum("ck,cki,ckj->cij", weight, jacobian, jacobian) / width[:, None, None] ** 2
        gradient = np.einsum("ck,cki,ck->ci", weight, jacobian, error) / width[:, None] ** 2
        normal[:, 3, 3] += 1.0 / (prior_sd * radii) ** 2
        gradient[:, 3] -= np.log(radii / start) / (prior_sd**2 * radii)
        normal[:, range(3), range(3)] += (0.5 / radii**2)[:, None]
        covariance = np.linalg.inv(normal)
        move = np.einsum("cij,cj->ci", covariance, gradient)
        move *= np.minimum(1.0, 0.3 * radii / np.maximum(np.linalg.norm(move, axis=1), 1e-12))[:, None]
        centers += move[:, :3]
        radii = np.maximum(radii + move[:, 3], 0.2 * start)
    return evidence(points, near, centers, radii, np.sqrt(covariance[:, 3, 3]))


def evidence(
    points: SurfacePoints, near: IntArray, centers: FloatArray, radii: FloatArray, radius_sds: FloatArray
) -> Spheres:
    """What the points of its neighbourhood (C, K) say for and against each of C spheres."""
    on, error, outward, distance = on_sphere(points, near, centers, radii)
    support = on.sum(axis=1).astype(np.float64)
    inside = ((near >= 0) & (distance < CORE * radii[:, None])).sum(axis=1)
    count = np.maximum(support, 1.0)
    bins = (outward @ unit_directions(BINS).T).argmax(axis=2)
    covered = np.zeros((len(radii), BINS), bool)
    rows, columns = np.nonzero(on)
    covered[rows, bins[rows, columns]] = True
    surface = outward * distance[:, :, None] * on[:, :, None]
    mean = surface.sum(axis=1) / count[:, None]
    spread = np.einsum("cki,ckj->cij", surface, surface) / count[:, None, None] - mean[:, :, None] * mean[:, None, :]
    least = np.sqrt(np.maximum(np.linalg.eigvalsh(spread)[:, 0], 0.0))
    return Spheres(
        centers=centers,
        radii=radii,
        radius_sds=radius_sds,
        support=support,
        shell=support / np.maximum(support + inside, 1.0),
        coverage=covered.mean(axis=1),
        thinness=least / radii,
        residual=(np.abs(error) * on).sum(axis=1) / count / radii,
    )


def on_sphere(
    points: SurfacePoints, near: IntArray, centers: FloatArray, radii: FloatArray
) -> tuple[NDArray[np.bool_], FloatArray, FloatArray, FloatArray]:
    """Of each neighbourhood (C, K): which points are on the sphere, their error, outward direction and distance."""
    offset = points.positions[near] - centers[:, None]
    distance = np.maximum(np.linalg.norm(offset, axis=2), 1e-12)
    outward = offset / distance[:, :, None]
    error = distance - radii[:, None]
    facing = np.einsum("ckj,ckj->ck", points.normals[near], outward)
    on = (near >= 0) & (np.abs(error) < SHELL * radii[:, None]) & (facing > FACING)
    return on, error, outward, distance


def unit_directions(count: int) -> FloatArray:
    """(count, 3) unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * index / count, np.pi * (1.0 + 5.0**0.5) * index
    flat = np.sqrt(1.0 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
