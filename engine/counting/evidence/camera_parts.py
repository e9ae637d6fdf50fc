"""Parts of a scene as large as a tree: no wider than the cameras that see them are far away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_FRUIT = 0.75
"""Share of the fruit whose distance from their middle is the width of a part: some others may lie far away."""
FAR, NEAREST_EYES = 3.0, 0.25
"""Fruit are far from a part if they are more than FAR times as far away as its nearest cameras, by this quantile."""
FEWEST_CAMERAS = 3
"""Cameras that a part needs."""


@dataclass(frozen=True, eq=False)
class CameraPart:
    """fruit: (K,) index of those in the part; middle: (3,) of them; distance: of the cameras from it, scene units."""

    fruit: IntArray
    middle: FloatArray
    distance: float


def split_by_cameras(centers: FloatArray, eyes: FloatArray) -> list[CameraPart]:
    """The fruit (F, 3), one or more, in parts no wider than the cameras nearest to them, of all at `eyes` (V, 3), are
    far away.

    A single tree is one part. A row is halved until the cameras of each part are as far from it as from a tree. A few
    fruit far away are a part if cameras stand at them.
    """
    open_parts, parts = [(np.arange(len(centers)), np.arange(len(eyes)))], list[CameraPart]()
    while open_parts:
        fruit, own = open_parts.pop()
        middle = np.median(centers[fruit], axis=0)
        away, seen_from = (np.linalg.norm(each - middle, axis=1) for each in (centers[fruit], eyes[own]))
        distance = float(np.median(seen_from))
        compact = float(np.quantile(away, MOST_FRUIT)) <= distance
        cut = away > FAR * np.quantile(seen_from, NEAREST_EYES) if compact else _half(centers[fruit])
        beyond = cut[cKDTree(centers[fruit]).query(eyes[own])[1]]
        if min(beyond.sum(), (~beyond).sum()) < FEWEST_CAMERAS:
            parts.append(CameraPart(fruit, middle, distance))
        else:
            open_parts += [(fruit[cut], own[beyond]), (fruit[~cut], own[~beyond])]
    return parts


def _half(centers: FloatArray) -> NDArray[np.bool_]:
    """(F,) which centres (F, 3) lie in one half of them, cut across the direction in which they spread most."""
    offsets = centers - centers.mean(axis=0)
    along = offsets @ np.linalg.svd(offsets, full_matrices=False)[2][0]
    return along * (1.0 if (along**3).sum() >= 0.0 else -1.0) > 0.0
