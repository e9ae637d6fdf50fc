"""Long fruit: an ellipsoid for the points of each sphere, as long as is typical of the scene.

A half-hidden fruit constrains its own length poorly. The typical elongation is estimated from all fruit of the scene
(`typical`, by expectation maximisation), and each fruit is held to a sphere accordingly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .cells import Cells
from .ellipsoid_kernels import fit_all
from .sphere import Spheres

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

REACH, MOST_POINTS = 1.6, 300
"""Radii within which points count, and how many of them."""
SHIFT, GROWTH = 0.05, 0.03
"""Deviations of the centre, in radii, and of the logarithm of the size from those of the sphere."""
TYPICAL = 0.05
"""Prior deviation of the logarithms of the axes from their mean."""
KNOWN = 4
"""Number of fruit that the prior counts for."""
ASKED, ROUNDS, STEPS = 200, 4, 8
"""Fruit needed to estimate the typical elongation, rounds of estimation, and steps of a fit."""


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """F ellipsoids of the volume of their spheres.

    spheres: with their centres and radii; axes: (F, 3, 3), rows: the half axes in radii, longest first, in a right-
    handed frame.
    """

    spheres: Spheres
    axes: FloatArray


def fit_ellipsoids(cells: Cells, normals: FloatArray, owners: IntArray, spheres: Spheres) -> Ellipsoids:
    """Refine F spheres into ellipsoids.

    cells, normals: the points (P, 3) in their cells and the normal of each; owners: (P,) the sphere of each, -1 for
    none.
    """
    count = len(spheres)
    if count == 0:
        return Ellipsoids(spheres, np.zeros((0, 3, 3)))
    asked, typical = np.arange(0, count, -(-count // ASKED)), TYPICAL
    for _ in range(ROUNDS):
        shapes, covariances = _fit(cells, normals, owners, spheres, asked, typical)
        spread = np.einsum("ki,ij,kj->k", shapes, _UNEVEN, shapes) + np.einsum("kij,ji->k", covariances, _UNEVEN)
        typical = float(np.sqrt((spread.sum() + 5 * KNOWN * TYPICAL**2) / (5 * (len(asked) + KNOWN))))
    shapes, _ = _fit(cells, normals, owners, spheres, np.arange(count), typical)
    values, vectors = np.linalg.eigh(np.eye(3) + _matrices(shapes[:, 3:]))
    lengths = 1.0 / np.maximum(values, 0.1)  # descending: the values ascend
    growth = np.cbrt(lengths.prod(axis=1))
    vectors[:, :, 2] *= np.linalg.det(vectors)[:, None]
    axes = (vectors * (lengths / growth[:, None])[:, None, :]).transpose(0, 2, 1)
    refined = replace(
        spheres,
        centers=spheres.centers + spheres.radii[:, None] * shapes[:, :3],
        radii=growth * spheres.radii,
        radius_sds=growth * spheres.radius_sds,
    )
    return Ellipsoids(refined, axes)


def _fit(
    cells: Cells, normals: FloatArray, owners: IntArray, spheres: Spheres, chosen: IntArray, typical: float
) -> tuple[FloatArray, FloatArray]:
    """Fit the chosen spheres and return shapes (K, 9) and their covariances; see `ellipsoid_kernels.fit_all`."""
    hold = np.zeros((9, 9))
    hold[:3, :3] = np.eye(3) / SHIFT**2
    hold += _UNEVEN / typical**2 + _EVEN / GROWTH**2
    shapes, covariances = np.empty((len(chosen), 9)), np.empty((len(chosen), 9, 9))
    fit_all(
        cells.table, normals, owners, spheres.centers, spheres.radii, chosen,
        REACH, MOST_POINTS, hold, STEPS, shapes, covariances,
    )  # fmt: skip
    return shapes, covariances


def _matrices(numbers: FloatArray) -> FloatArray:
    """(K, 3, 3) symmetric matrices from their numbers (K, 6): xx, yy, zz, xy, xz, yz."""
    return numbers[:, [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


def _quadratic(diagonal: FloatArray, other: float) -> FloatArray:
    form = np.zeros((9, 9))
    form[3:6, 3:6] = diagonal
    form[6:, 6:] = other * np.eye(3)
    return form


_UNEVEN = _quadratic(np.eye(3) - 1.0 / 3.0, 2.0)
"""Squared norm of the deviatoric part of S."""
_EVEN = _quadratic(np.full((3, 3), 1.0 / 9.0), 0.0)
"""Square of the mean of its diagonal."""
