"""What a click shows: the Gaussians around a place that are alike."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from ..features.features import Features
from ..prompts.relevancy import MIN_WEIGHT
from .learning import Background, scale_of

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SEEDS = 6
"""Gaussians nearest to the place; their mean evidence is what the others are compared with."""
ALIKE = 0.7
"""Root mean square difference of evidence, in standard deviations of the scene, up to which Gaussians are alike."""
NEIGHBOURS = 8
"""Alike Gaussians that a region grows to from each of its own."""
FARTHEST, MOST = 2000, 80
"""How many Gaussians around the place are compared, and how many a region has at most: a part of a fruit is enough,
and a larger region more often reaches beyond it."""
SAMPLE = 4000
"""Gaussians that stand for the background of a scene."""


@dataclass(frozen=True, eq=False)
class Ground:
    """The Gaussians of a scene that photos show, ready for clicks.

    rows: (M,) which of all Gaussians; means: (M, 3) scene units; evidence: (M, F); weights: (M,) pixels.
    """

    rows: IntArray
    means: FloatArray
    evidence: FloatArray
    weights: FloatArray
    tree: cKDTree

    @classmethod
    def of(cls, means: Tensor, features: Features) -> Ground:
        """Of Gaussians at means (N, 3) with their features."""
        weights = features.weights.amax(1).double().numpy()
        places = means.detach().double().cpu().numpy()
        rows = np.flatnonzero((weights >= MIN_WEIGHT) & np.isfinite(places).all(axis=1))
        evidence = features.evidence().double().numpy()[rows]
        return cls(rows, places[rows], evidence, weights[rows], cKDTree(places[rows]))

    def sample_background(self, prior: FloatArray, seed: int = 0) -> Background:
        """Take a sample of the scene, each Gaussian with a chance proportional to its pixels. prior: (M,) log odds of
        the word that is refined, see `Examples`."""
        chance = self.weights / self.weights.sum()
        size = min(SAMPLE, int((chance > 0.0).sum()))
        chosen = np.sort(np.random.default_rng(seed).choice(len(self.rows), size, replace=False, p=chance))
        return Background(self.evidence[chosen], prior[chosen], np.ones(len(chosen)))

    @cached_property
    def _scale(self) -> tuple[FloatArray, FloatArray]:
        return scale_of(self.evidence, self.weights)

    def grow_region(self, place: FloatArray) -> IntArray:
        """Grow the region of a click at a place (3,), scene units, as places in `rows`: alike Gaussians that hang
        together, the nearest first."""
        if len(self.rows) < SEEDS:
            return np.arange(len(self.rows))
        mean, spread = self._scale
        _, near = self.tree.query(place, k=min(FARTHEST, len(self.rows)))
        own = (self.evidence[near] - mean) / spread
        typical = np.average(own[:SEEDS], axis=0, weights=self.weights[near[:SEEDS]])
        alike = np.sqrt(((own - typical) ** 2).mean(axis=1)) < ALIKE
        alike[0] = True
        found: IntArray = near[alike]
        return found[_find_connected(self.means[found])][:MOST]


def _find_connected(places: FloatArray) -> NDArray[np.bool_]:
    """Find which (n,) of places (n, 3) hang together with the first."""
    _, near = cKDTree(places).query(places, k=min(NEIGHBOURS + 1, len(places)))
    near = near.reshape(len(places), -1)
    one = np.repeat(np.arange(len(places)), near.shape[1])
    links = coo_matrix((np.ones(len(one)), (one, near.ravel())), shape=(len(places), len(places)))
    _, group = connected_components(links, directed=False)
    same: NDArray[np.bool_] = group == group[0]
    return same
