"""A template aligned to points by iterative closest points, and their remaining distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .template_shape import Template

FloatArray = NDArray[np.float64]

ROUNDS = 20
MOST = 200
"""Points, evenly thinned, that a template is aligned to."""
SETTLED = 2e-3
"""A step of the centre that ends the iterations."""
QUANTILE = 0.95
"""Quantile of the distances that is used as the Hausdorff distance: a single stray point must not decide it."""


@dataclass(frozen=True, eq=False)
class Registration:
    """Lengths are in fruit diameters.

    center: (3,) of the template; off: distance of the points from the template; bare: distance of the template's points
    from them, which is large for a fruit that is visible from one side only.
    """

    center: FloatArray
    off: float
    bare: float

    @property
    def hausdorff(self) -> float:
        """The Hausdorff distance between points and template."""
        return max(self.off, self.bare)


def register(points: FloatArray, template: Template, start: FloatArray) -> Registration:
    """Align the template to points (M, 3) in fruit diameters; start: (3,) a first estimate of its centre.

    Every point is moved to the nearest one of the template, not the other way round: the hidden side of a fruit would
    otherwise pull the template into the visible side.
    """
    points = points[np.linspace(0, len(points) - 1, min(len(points), MOST)).astype(np.int64)]
    tree = cKDTree(template.points)
    turn, center = np.eye(3), start
    for _ in range(ROUNDS):
        there, before = template.points[tree.query((points - center) @ turn)[1]], center
        turn = _rotation(there, points)
        center = points.mean(axis=0) - turn @ there.mean(axis=0)
        if np.linalg.norm(center - before) < SETTLED:
            break
    placed = (points - center) @ turn
    off, bare = tree.query(placed)[0], cKDTree(placed).query(template.points)[0]
    return Registration(center, float(np.quantile(off, QUANTILE)), float(np.quantile(bare, QUANTILE)))


def _rotation(origin: FloatArray, target: FloatArray) -> FloatArray:
    """(3, 3) the rotation R for which R (origin − mean) comes nearest to target − mean (Kabsch 1976)."""
    left, _, right = np.linalg.svd((target - target.mean(axis=0)).T @ (origin - origin.mean(axis=0)))
    left[:, -1] *= np.sign(np.linalg.det(left @ right))
    turn: FloatArray = left @ right
    return turn
