"""Pieces of wood. World frame: z up, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Branch:
    """A curved, tapering piece of wood; generation 0 is the trunk, 1 a limb, 2 a branch, 3 a twig."""

    points: FloatArray
    """(K, 3) centre line from the base to the tip."""
    radii: FloatArray
    """(K,) half thickness."""
    generation: int

    @property
    def span(self) -> float:
        """Length along the centre line."""
        return float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())

    def at(self, fraction: float) -> tuple[FloatArray, FloatArray]:
        """Position and unit direction at a fraction of the length."""
        place = fraction * (len(self.points) - 1)
        i = min(int(place), len(self.points) - 2)
        step = self.points[i + 1] - self.points[i]
        return self.points[i] + (place - i) * step, step / np.linalg.norm(step)

    def radius_at(self, fraction: float) -> float:
        """Half thickness at a fraction of the length."""
        return float(np.interp(fraction * (len(self.radii) - 1), np.arange(len(self.radii)), self.radii))


def to_unit(v: FloatArray) -> FloatArray:
    """Return the vector, or each row, at length 1."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def sample_wood(branches: Sequence[Branch], spacing: float = 0.012) -> FloatArray:
    """Sample points (M, 4) along every centre line with the radius there."""
    rows = []
    for branch in branches:
        k = np.linspace(0.0, len(branch.points) - 1.0, max(2, int(branch.span / spacing)))
        knots = np.arange(len(branch.points))
        rows.append(np.stack([np.interp(k, knots, c) for c in (*branch.points.T, branch.radii)], axis=1))
    return np.vstack(rows)
