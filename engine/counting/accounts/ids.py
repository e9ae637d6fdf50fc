"""Stable fruit ids: a later count of the same scene gives a fruit the id that an earlier count gave it."""

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
    """Every fruit that earlier counts of the scene numbered, at the position of the last count that found it. ids:
    (K,); centers: (K, 3) in the scene frame; diameters: (K,) scene units; last: the highest id ever used in the scene,
    including results that stored only their own fruit."""

    ids: IntArray
    centers: FloatArray
    diameters: FloatArray
    last: int


NO_FRUIT = KnownFruit(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), 0)


def number(centers: FloatArray, order: IntArray, diameter: float, known: KnownFruit = NO_FRUIT) -> IntArray:
    """(F,) the id of each fruit: that of the known fruit it matches, one to one, else a new id.

    centers: (F, 3); order: (F,) in which new ids are given, from known.last + 1; diameter: mean, scene units.
    """
    # The smaller of both: a count that mistook the crown for one fruit must not take over an id from far away.
    same = match_centers(centers, known.centers, NEAR * np.minimum(diameter, known.diameters))
    ids = np.zeros(len(centers), np.int64)
    ids[same.predicted] = known.ids[same.true]
    new = order[ids[order] == 0]
    ids[new] = known.last + 1 + np.arange(len(new))
    return ids
