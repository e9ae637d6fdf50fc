"""Robust sphere fits to surface points, many at once, with measures of their quality."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .cells import Cells, choose_apart
from .sphere_kernels import fit_all, weigh_all

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

REACH = 1.6
"""Points within this many radii of a start belong to its neighbourhood."""
SHELL = 0.25
"""A point within this many radii of the surface, its normal outwards, is on the sphere."""
CORE = 0.65
"""A point nearer to the centre than this many radii counts against the sphere."""
FACING = 0.2
"""Least cosine between a point's normal and its direction from the centre for the point to be on the sphere."""
NEIGHBORS = 384
"""Points of a fit."""
MOST_POINTS = 4096
"""Points used to evaluate a sphere."""
BINS = 60
"""Directions in which the coverage of a sphere is counted."""


@dataclass(frozen=True, eq=False)
class Spheres:
    """C fitted spheres.

    centers: (C, 3), radii: (C,), radius_sds: (C,) scene units; support: (C,) number of points on the sphere;
    shell: (C,) of those and of the points well inside, the share on the sphere; coverage: (C,) share of directions in
    which the sphere has points; thinness: (C,) least standard deviation of the points on it, in radii; residual: (C,)
    mean distance of these from the surface, in radii; agreement: (C,) mean cosine between the normals of all points
    near the surface and their directions from the centre.
    """

    centers: FloatArray
    radii: FloatArray
    radius_sds: FloatArray
    support: FloatArray
    shell: FloatArray
    coverage: FloatArray
    thinness: FloatArray
    residual: FloatArray
    agreement: FloatArray

    def __len__(self) -> int:
        return len(self.radii)

    def select(self, index: NDArray) -> Spheres:
        """The spheres at `index` (bool mask (C,) or integer indices)."""
        return Spheres(**{field.name: getattr(self, field.name)[index] for field in fields(self)})

    def where(self, chosen: NDArray[np.bool_], others: Spheres) -> Spheres:
        """These spheres where `chosen` (C,) is true, the others elsewhere."""

        def pick(name: str) -> FloatArray:
            own, other = getattr(self, name), getattr(others, name)
            return np.where(chosen[:, None] if own.ndim == 2 else chosen, own, other)

        return Spheres(**{field.name: pick(field.name) for field in fields(self)})


def fit_spheres(
    cells: Cells,
    normals: FloatArray,
    starts: FloatArray,
    reaches: FloatArray,
    radii: FloatArray,
    *,
    prior: float,
    prior_sd: float,
    rounds: int = 12,
    limit: int = NEIGHBORS,
    same: float = 0.0,
) -> Spheres:
    """Refine C spheres on the points within reaches (C,) of starts (C, 3), by Gauss-Newton with redescending weights.

    cells, normals: the points (P, 3) in their cells, and the normal of each; radii: (C,) starts. A normal prior of
    deviation `prior_sd` holds log r near that of `prior`: for a half-visible cap alone, centre and radius are
    correlated. Of more than `limit` points, an even sample is used. Of spheres whose centres and radii differ by less
    than `same` radii, those of earlier starts remain.
    """
    count = len(starts)
    centers, fitted, sds = np.empty((count, 3)), np.empty(count), np.empty(count)
    starts, reaches, radii = (np.ascontiguousarray(each, dtype=np.float64) for each in (starts, reaches, radii))
    fit_all(cells.table, normals, starts, reaches, radii, prior, prior_sd, rounds, limit, centers, fitted, sds)
    if same > 0.0 and count:
        kept = _find_distinct(centers, fitted, same)
        centers, fitted, sds = centers[kept], fitted[kept], sds[kept]
    return weigh_spheres(cells, normals, centers, fitted, sds)


def _find_distinct(centers: FloatArray, radii: FloatArray, same: float) -> IntArray:
    """Find which of C spheres differ by `same` radii or more, in centre or radius, from those kept before."""
    places = Cells.of(centers, same * float(np.median(radii)))
    order = np.argsort(places.index, kind="stable")
    return np.sort(places.index[choose_apart(places.table, radii[places.index], order, same)])


def weigh_spheres(
    cells: Cells, normals: FloatArray, centers: FloatArray, radii: FloatArray, radius_sds: FloatArray
) -> Spheres:
    """Measure the quality of each of C spheres on the points."""
    found = np.empty((len(radii), 6))
    reaches = (1.0 + SHELL) * radii
    directions = unit_directions(BINS)
    weigh_all(cells.table, normals, centers, radii, reaches, MOST_POINTS, SHELL, CORE, FACING, directions, found)
    support, inside, coverage, thinness, residual, agreement = found.T
    return Spheres(
        centers=centers,
        radii=radii,
        radius_sds=radius_sds,
        support=support,
        shell=support / np.maximum(support + inside, 1.0),
        coverage=coverage,
        thinness=thinness,
        residual=residual,
        agreement=agreement,
    )


def unit_directions(count: int) -> FloatArray:
    """(count, 3) unit vectors spread evenly over the sphere (Fibonacci lattice)."""
    index = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * index / count, np.pi * (1.0 + 5.0**0.5) * index
    flat = np.sqrt(1.0 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
