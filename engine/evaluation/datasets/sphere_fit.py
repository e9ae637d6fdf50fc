"""A sphere through the points of one fruit, without normals: most scans show one side and some leaf."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

LEAST_POINTS = 4
"""Fewer points do not determine a sphere."""

_TRIALS = 400
_MOST_POINTS = 2000
_TOLERANCE = 0.03
"""Distance from the surface, in extents of the points, at which a point counts a quarter in the choice among trials.

In extents, not in radii: a share of the radius would favour the large spheres that graze a leaf.
"""
_LEEWAY = 1.5
"""The radius stays within this factor of its start's, and a trial's of a known one."""


@dataclass(frozen=True, eq=False)
class FittedSphere:
    """center: (3,) and radius in the points' unit."""

    center: FloatArray
    radius: float


def fit_sphere(points: FloatArray, radius: float | None = None, seed: int = 0) -> FittedSphere | None:
    """Fit a sphere to surface points (P, 3) with outliers; None if they do not determine one.

    Seeded trials of four points each; the one near most points starts a least-squares fit with redescending weights.
    For one visible side, centre and radius are correlated: with a measured `radius` only the centre is free.
    """
    points = _thin(points)
    if len(points) < LEAST_POINTS:
        return None
    middle = points.mean(axis=0)
    local = points - middle
    start = _best_trial(local, radius, np.random.default_rng(seed))
    if start is None:
        return None
    fitted = _refine(local, start, free=radius is None)
    return FittedSphere(fitted.center + middle, fitted.radius)


def _thin(points: FloatArray) -> FloatArray:
    """Take at most a few thousand distinct points, evenly sampled: scans repeat points."""
    distinct = np.unique(np.asarray(points, dtype=np.float64), axis=0)
    if len(distinct) <= _MOST_POINTS:
        return distinct
    return distinct[np.linspace(0, len(distinct) - 1, _MOST_POINTS).astype(np.int64)]


def _best_trial(points: FloatArray, radius: float | None, generator: np.random.Generator) -> FittedSphere | None:
    corners = points[generator.integers(0, len(points), (_TRIALS, 4))]
    edges = 2.0 * (corners[:, 1:] - corners[:, :1])
    squares = (corners[:, 1:] ** 2).sum(axis=2) - (corners[:, :1] ** 2).sum(axis=2)
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    solvable = np.abs(np.linalg.det(edges)) > 1e-9 * max(extent, 1e-12) ** 3
    if not solvable.any():
        return None
    centers = np.linalg.solve(edges[solvable], squares[solvable][:, :, None])[:, :, 0]
    radii = np.linalg.norm(corners[solvable, 0] - centers, axis=1)
    # A larger sphere than this is a plane, a smaller one a few points.
    low, high = (0.1 * extent, 1.5 * extent) if radius is None else (radius / _LEEWAY, radius * _LEEWAY)
    plausible = (radii > low) & (radii < high)
    if not plausible.any():
        return None
    centers, radii = centers[plausible], radii[plausible]
    errors = np.abs(np.linalg.norm(points[None] - centers[:, None], axis=2) - radii[:, None])
    best = int((1.0 / (1.0 + (errors / (_TOLERANCE * extent)) ** 2) ** 2).sum(axis=1).argmax())
    return FittedSphere(centers[best], float(radii[best]) if radius is None else radius)


def _refine(points: FloatArray, start: FittedSphere, *, free: bool) -> FittedSphere:
    """Refine a sphere by Gauss-Newton on the distances from the surface; weights fall off beyond a width that
    narrows."""
    center, radius = start.center, start.radius
    for step in range(30):
        offset = points - center
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-12)
        outward = offset / distance[:, None]
        error = distance - radius
        width = max(0.3 - 0.03 * step, 0.08) * radius
        weight = 1.0 / (1.0 + (error / width) ** 2) ** 2
        columns = np.concatenate([outward, np.ones((len(points), 1))], axis=1) if free else outward
        normal = (columns * weight[:, None]).T @ columns
        normal += 1e-9 * np.eye(len(normal)) * max(float(np.trace(normal)), 1e-12)
        move = np.linalg.solve(normal, columns.T @ (weight * error))
        move *= min(1.0, 0.5 * radius / max(float(np.linalg.norm(move[:3])), 1e-12))
        center = center + move[:3]
        if free:
            radius = float(np.clip(radius + move[3], start.radius / _LEEWAY, start.radius * _LEEWAY))
    return FittedSphere(center, radius)
