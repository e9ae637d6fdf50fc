"""Numbers of fruit that stay: a later count of the same scene calls each fruit what an earlier one called it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .fruit import NEAR
from .matching import match_centers

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class KnownFruit:
    """What an earlier count of the scene found. ids: (K,); centers: (K, 3) in the scene's frame; last: the highest id
    that was ever given in the scene, which a fruit that has gone since may have had."""

    ids: IntArray
    centers: FloatArray
    last: int


NOBODY = KnownFruit(np.zeros(0, np.int64), np.zeros((0, 3)), 0)


def number(centers: FloatArray, order: IntArray, diameter: float, known: KnownFruit = NOBODY) -> IntArray:
    """(F,) the id of each fruit: of the known one that it is matched with, one to one, else a new one.

    centers: (F, 3); order: (F,) in which new ids are given, from known.last + 1 on; diameter: mean, scene units.
    """
    same = match_centers(centers, known.centers, NEAR * diameter)
    ids = np.zeros(len(centers), np.int64)
    ids[same.predicted] = known.ids[same.true]
    new = order[ids[order] == 0]
    ids[new] = known.last + 1 + np.arange(len(new))
    return ids
