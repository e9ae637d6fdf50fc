"""What the Gaussians say about spheres: which lie in them, and which fruit were found on their surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]

MATCHING = 1.0 / 3.0
"""Probability of the prompt from which a Gaussian may belong to a fruit."""
AROUND, WITHIN = 1.15, 0.8
"""Radii within which Gaussians of the fruit, and others, count."""
FARTHEST = 1.2
"""Distance of the nearest fruit, in diameters, above which it is not near."""
NEAR = 0.3
"""Diameters within which a fruit is the same one."""
NUMBERS = 5
"""How many numbers `Surroundings.numbers` gives."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """The Gaussians that may belong to fruit and the others, and F fruit that were found on surfaces.

    places: trees of the means of the M Gaussians that match the prompt, opacities, probabilities: (M,) of these;
    others: tree of the N other means, other_opacities: (N,); fruit: (F, 3) centres; diameter: of a fruit, scene units.
    """

    places: cKDTree
    opacities: FloatArray
    probabilities: FloatArray
    others: cKDTree
    other_opacities: FloatArray
    fruit: FloatArray
    diameter: float

    @classmethod
    def of(
        cls, gaussians: Gaussians, probabilities: FloatArray, fruit: FloatArray, diameter: float, threshold: float
    ) -> Surroundings:
        """threshold: of the Gaussians' probabilities (N,)."""
        means = gaussians.means.detach().double().cpu().numpy()
        opacities = gaussians.opacities.detach().double().cpu().numpy()
        scaled = np.minimum(probabilities * (0.5 / threshold), 1.0)
        own = scaled > MATCHING
        return cls(
            cKDTree(means[own]), opacities[own], scaled[own], cKDTree(means[~own]), opacities[~own], fruit, diameter
        )

    @cached_property
    def _fruit_tree(self) -> cKDTree:
        return cKDTree(self.fruit)

    def numbers(self, centers: FloatArray, radii: FloatArray) -> FloatArray:
        """(C, NUMBERS) about spheres, centers (C, 3) and radii (C,): distance of the nearest fruit in diameters,
        whether it is the same, opacity of the matching Gaussians around, of the others within, and mean probability of
        the former."""
        distances = np.full(len(centers), FARTHEST)
        if len(self.fruit):
            distances = self._fruit_tree.query(centers)[0] / self.diameter
        around, probable = _sums(self.places, centers, AROUND * radii, self.opacities, self.probabilities)
        within, _ = _sums(self.others, centers, WITHIN * radii, self.other_opacities, self.other_opacities)
        same = np.exp(-((distances / NEAR) ** 2))
        mean = probable / np.maximum(around, 1e-6)
        return np.stack([np.minimum(distances, FARTHEST), same, np.log1p(around), np.log1p(within), mean], axis=1)


def _sums(
    places: cKDTree, centers: FloatArray, reaches: FloatArray, weights: FloatArray, values: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(C,) sums of weights (M,), and of weights times values (M,), of the M places within each reach (C,)."""
    near = places.query_ball_point(centers, reaches, return_sorted=True)
    lengths = np.array([len(each) for each in near], np.int64)
    index = np.concatenate([np.array(each, np.int64) for each in near]) if len(near) else np.zeros(0, np.int64)
    owners = np.repeat(np.arange(len(centers)), lengths)
    total: FloatArray = np.bincount(owners, weights[index], len(centers)).astype(np.float64)
    product: FloatArray = np.bincount(owners, weights[index] * values[index], len(centers)).astype(np.float64)
    return total, product
