"""Numbers of fruit that stay: a later count of the same scene calls each fruit what any earlier one called it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..fruit import NEAR
from ..geometry.matching import match_centers

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class KnownFruit:
    """Every fruit that earlier counts of the scene numbered, where the last count that found it did. ids: (K,);
    centers: (K, 3) in the scene's frame; diameters: (K,) scene units; last: the highest id that was ever given in the
    scene, also by results that kept only the fruit of their own count."""

    ids: IntArray
    centers: FloatArray
    diameters: FloatArray
    last: int


NOBODY = KnownFruit(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), 0)


def number(centers: FloatArray, order: IntArray, diameter: float, known: KnownFruit = NOBODY) -> IntArray:
    """(F,) the id of each fruit: of the known one that it is matched with, one to one, else a new one.

    centers: (F, 3); order: (F,) in which new ids are given, from known.last + 1 on; diameter: mean, scene units.
    """
    # Of the smaller of both: a count that took the crown for one fruit must not take a number from far away.
    same = match_centers(centers, known.centers, NEAR * np.minimum(diameter, known.diameters))
    ids = np.zeros(len(centers), np.int64)
    ids[same.predicted] = known.ids[same.true]
    new = order[ids[order] == 0]
    ids[new] = known.last + 1 + np.arange(len(new))
    return ids
