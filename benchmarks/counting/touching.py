"""Touching pairs of fruit: is each of the two counted once?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...engine.evaluation.truth import Truth

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

TOUCH = 1.1
"""Fruit touch if their centres are at most this many mean diameters apart."""
SHOWN = (0.5, 0.7)
"""Bounds of the visible share of either fruit of a pair."""
INSIDE, BESIDE = 0.5, 1.0
"""A counted fruit is on the true one within this many of its diameters, and belongs to it within this many."""


@dataclass(frozen=True)
class Touching:
    """Number of pairs, and of those in which each fruit has exactly one counted fruit, which is on it."""

    pairs: int
    apart: int


def find_touching_pairs(truth: Truth) -> IntArray:
    """Find the indices (K, 2) of true fruit that touch and are both visible to about 60 %."""
    tree = KDTree(truth.centers)
    near = tree.query_pairs(TOUCH * float(truth.diameters.max(initial=0.0)), output_type="ndarray").reshape(-1, 2)
    one, other = near.T
    distances = np.linalg.norm(truth.centers[one] - truth.centers[other], axis=1)
    seen = (truth.visible_fractions >= SHOWN[0]) & (truth.visible_fractions <= SHOWN[1])
    chosen = (distances <= TOUCH * 0.5 * (truth.diameters[one] + truth.diameters[other])) & seen[one] & seen[other]
    return near[chosen].astype(np.int64)


def count_separated(centers: FloatArray, truth: Truth) -> Touching:
    """centers: (P, 3) of the counted fruit. Each belongs to the true fruit, visible or not, that is nearest in units of
    its diameter."""
    pairs = find_touching_pairs(truth)
    if len(pairs) == 0 or len(centers) == 0:
        return Touching(len(pairs), 0)
    distances = np.linalg.norm(centers[:, None] - truth.centers, axis=2) / truth.diameters
    owner = distances.argmin(axis=1)
    nearest = distances[np.arange(len(centers)), owner]
    owned = np.bincount(owner[nearest <= BESIDE], minlength=len(truth.centers))
    on_it = np.bincount(owner[nearest <= INSIDE], minlength=len(truth.centers))
    once = (owned == 1) & (on_it == 1)
    return Touching(len(pairs), int(once[pairs].all(axis=1).sum()))
