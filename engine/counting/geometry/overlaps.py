"""Spheres that overlap: whether one is nearer to others than a share of the sum of their radii."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from .matching import ROUNDING

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Overlaps:
    """Finds overlaps with those of C spheres that are chosen (C,). centers: (C, 3); radii: (C,); share: of the sum of
    two radii below which the distance of the centers is an overlap; tree: of all centers; largest: radius."""

    centers: FloatArray
    radii: FloatArray
    share: float
    tree: cKDTree
    chosen: NDArray[np.bool_]
    largest: float

    @classmethod
    def of(cls, centers: FloatArray, radii: FloatArray, share: float) -> Overlaps:
        """None of the spheres is chosen yet."""
        chosen = np.zeros(len(radii), bool)
        return cls(centers, radii, share, cKDTree(centers), chosen, float(radii.max(initial=0.0)))

    def any_chosen(self, index: int) -> bool:
        """Whether sphere `index` overlaps with a chosen one."""
        return self.any_near(self.centers[index], float(self.radii[index]))

    def any_near(self, center: FloatArray, radius: float) -> bool:
        """Whether a sphere with a center (3,) and a radius overlaps with a chosen one."""
        reach = ROUNDING * self.share * (radius + self.largest)
        near = np.array(self.tree.query_ball_point(center, reach), np.int64)
        near = near[self.chosen[near]]
        between = np.linalg.norm(self.centers[near] - center, axis=1)
        return bool((between < self.share * (self.radii[near] + radius)).any())
