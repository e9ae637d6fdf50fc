"""A sphere through the points of one fruit, without normals: most of a scan shows one side and some leaf."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEAST_POINTS = 4
"""Fewer points do not fix a sphere."""

_TRIALS = 400
_MOST_POINTS = 2000
_TOLERANCE = 0.08
"""Distance from the surface, in radii, at which a point counts a quarter in the choice among trials."""


@dataclass(frozen=True, eq=False)
class FittedSphere:
    """center: (3,) and radius in the points' unit."""

    center: FloatArray
    radius: float


def fit_sphere(points: FloatArray, seed: int = 0) -> FittedSphere | None:
    """Fit a sphere to surface points (P, 3) of which a part may lie elsewhere; None where they fix none.

    Seeded trials of four points each; the one near most points starts a least-squares fit with redescending weights.
    """
    points = _thinned(points)
    if len(points) < LEAST_POINTS:
        return None
    middle = points.mean(axis=0)
    local = points - middle
    start = _best_trial(local, np.random.default_rng(seed))
    if start is None:
        return None
    center, radius = _refined(local, start.center, start.radius, free=True)
    return FittedSphere(center + middle, radius)


def fit_center(points: FloatArray, start: FittedSphere, radius: float) -> FloatArray:
    """(3,) centre of the sphere of known radius through surface points (P, 3), from a free fit of them.

    A side seen alone leaves centre and radius tied to each other; with the radius measured only the centre is free.
    """
    points = _thinned(points)
    middle = points.mean(axis=0)
    toward = start.center - middle
    length = float(np.linalg.norm(toward))
    # From the surface seen, the centre is `radius` away, wherever the free fit put it on that line.
    guess = toward * max(length + radius - start.radius, 0.0) / length if length > 0.0 else toward
    center, _ = _refined(points - middle, guess, radius, free=False)
    return center + middle


def _thinned(points: FloatArray) -> FloatArray:
    """At most a few thousand distinct points, evenly taken: scans repeat points."""
    distinct = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    if len(distinct) <= _MOST_POINTS:
        return distinct
    return distinct[np.linspace(0, len(distinct) - 1, _MOST_POINTS).astype(np.int64)]


def _best_trial(points: FloatArray, generator: np.random.Generator) -> FittedSphere | None:
    draws = generator.integers(0, len(points), (_TRIALS, 4))
    corners = points[draws]
    edges = 2.0 * (corners[:, 1:] - corners[:, :1])
    squares = (corners[:, 1:] ** 2).sum(axis=2) - (corners[:, :1] ** 2).sum(axis=2)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    solvable = np.abs(np.linalg.det(edges)) > 1e-9 * max(extent, 1e-12) ** 3
    if not solvable.any():
        return None
    centers = np.linalg.solve(edges[solvable], squares[solvable][:, :, None])[:, :, 0]
    radii = np.linalg.norm(corners[solvable, 0] - centers, axis=1)
    plausible = (radii < 2.0 * extent) & (radii > 0.1 * extent)  # a larger one is a plane, a smaller one a few points
    if not plausible.any():
        return None
    centers, radii = centers[plausible], radii[plausible]
    errors = np.abs(np.linalg.norm(points[None] - centers[:, None], axis=2) - radii[:, None])
    scores = (1.0 / (1.0 + (errors / (_TOLERANCE * radii[:, None])) ** 2) ** 2).sum(axis=1)
    best = int(scores.argmax())
    return FittedSphere(centers[best], float(radii[best]))


def _refined(points: FloatArray, center: FloatArray, radius: float, *, free: bool) -> tuple[FloatArray, float]:
    """Gauss-Newton on the distances from the surface; weights fall off beyond a width that narrows."""
    for step in range(30):
        offset = points - center
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
        outward = offset / distance[:, None]
        error = distance - radius
        width = max(0.3 - 0.03 * step, _TOLERANCE) * radius
        weight = 1.0 / (1.0 + (error / width) ** 2) ** 2
        columns = np.concatenate([outward, np.ones((len(points), 1))], axis=1) if free else outward
        normal = (columns * weight[:, None]).T @ columns
        normal += 1e-9 * np.eye(len(normal)) * max(float(np.trace(normal)), 1e-12)
        move = np.linalg.solve(normal, columns.T @ (weight * error))
        move *= min(1.0, 0.5 * radius / max(float(np.linalg.norm(move[:3])), 1e-12))
        center = center + move[:3]
        if free:
            radius = float(np.clip(radius + move[3], 0.5 * radius, 2.0 * radius))
    return center, radius
