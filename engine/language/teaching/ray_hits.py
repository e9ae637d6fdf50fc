"""The point where a ray hits a reconstruction: the surface that stops half of the light, or the nearest sparse
point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]

SIGMAS = 3.0
"""Standard deviations within which a Gaussian can stop light."""
LEAST_ALPHA = 1.0 / 255.0
"""Least opacity of a Gaussian that stops light, as in drawing."""


def pick_surface(
    origin: NDArray[np.float64],
    direction: NDArray[np.float64],
    means: FloatArray,
    scales: FloatArray,
    quats: FloatArray,
    opacities: FloatArray,
) -> NDArray[np.float64] | None:
    """(3,) the point where Gaussians have stopped half of the light of a ray; None if they do not.

    Each Gaussian stops light where the ray is deepest in it (as in ray-traced splatting, Moenne-Loccoz et al. 2024), so
    the depth is that of the engine's surfaces. origin, unit direction: (3,); means (N, 3) and scales (N, 3) in the same
    frame; quats: (N, 4), w first; opacities: (N,).
    """
    offsets = means - origin.astype(means.dtype)
    along = offsets @ direction.astype(means.dtype)
    apart = np.einsum("ij,ij->i", offsets, offsets) - along**2
    reach = SIGMAS * scales.max(axis=1)
    near = np.flatnonzero((along > -reach) & (apart < reach**2))
    if len(near) == 0:
        return None
    turns = np.moveaxis(np.array(rotation_rows(quats[near].astype(np.float64))), -1, 0)
    widths = np.maximum(scales[near].astype(np.float64), 1e-12)
    start = -np.einsum("nij,ni->nj", turns, offsets[near].astype(np.float64)) / widths
    course = np.einsum("nij,i->nj", turns, direction) / widths
    depth = -np.einsum("ni,ni->n", start, course) / np.einsum("ni,ni->n", course, course)
    closest = start + depth[:, None] * course
    alpha = opacities[near] * np.exp(-0.5 * np.einsum("ni,ni->n", closest, closest))
    stops = (depth > 0.0) & (alpha >= LEAST_ALPHA)
    order = np.argsort(depth[stops], kind="stable")
    left = np.cumprod(1.0 - np.minimum(alpha[stops][order], 0.999))
    stopped = np.flatnonzero(left <= 0.5)
    return origin + depth[stops][order][stopped[0]] * direction if len(stopped) else None


def pick_point(
    origin: NDArray[np.float64], direction: NDArray[np.float64], points: FloatArray, *, slope: float, reach: float
) -> NDArray[np.float64] | None:
    """(3,) the first of points (P, 3) that a ray comes near to; None if there is none.

    Near means within `slope` times the point's depth (pixels in a perspective view) or `reach` (in an orthographic
    one).
    """
    offsets = points - origin
    along = offsets @ direction
    apart = np.sqrt(np.maximum(np.einsum("ij,ij->i", offsets, offsets) - along**2, 0.0))
    near = np.flatnonzero((along > 0.0) & (apart <= np.maximum(slope * along, reach if slope == 0.0 else 0.0)))
    if len(near) == 0:
        return None
    return np.asarray(points[near[np.argmin(along[near])]], np.float64)


def rotation_rows(quats: NDArray[np.floating]) -> list[list[NDArray[np.floating]]]:
    """The rotations of quaternions (N, 4), w first, of any length: rows of columns, (N,) each.

    A Gaussian's own axes are the columns.
    """
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)).T
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
