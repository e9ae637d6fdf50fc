"""The result for every prediction and every true fruit: found, double, false, merged or missed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..counting.geometry.matching import Matching, match_centers, pairs_within
from ..errors import CountingError
from .truth import Truth

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Judgement:
    """P predictions against a truth.

    radius: in mean true diameters; diameters: (P,) of the predictions, scene units; pairs: matched with visible fruit.
    Of the other predictions `ignored` lie on true fruit that is not visible, `doubles` on a fruit that another
    prediction has, `false` on none. Of the other visible fruit `merged` lie under a prediction that is matched with
    another one, `missed` do not. All are index arrays, rising.
    """

    radius: float
    diameters: FloatArray
    pairs: Matching
    ignored: IntArray
    doubles: IntArray
    false: IntArray
    merged: IntArray
    missed: IntArray

    @property
    def predictions(self) -> int:
        return len(self.diameters)


def judge(centers: FloatArray, diameters: FloatArray, truth: Truth, radius: float = 0.5) -> Judgement:
    """Match predicted fruit, centers (P, 3) and diameters (P,) in scene units, with true ones at a radius.

    Visible fruit are matched first; of the remaining predictions, those that match other true fruit are ignored.

    Raises:
        CountingError: a prediction's centre or diameter is not a finite number, or there is not one diameter a centre.
    """
    centers = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    diameters = np.asarray(diameters, dtype=np.float64).reshape(-1)
    if len(centers) != len(diameters):
        raise CountingError(f"There are {len(centers)} predicted centres and {len(diameters)} diameters. Give as many")
    broken = int((~np.isfinite(centers).all(axis=1) | ~np.isfinite(diameters)).sum())
    if broken:
        raise CountingError(f"{broken} of {len(centers)} predictions have no finite centre or diameter. Count again")
    reach = radius * truth.mean_diameter
    visible, hidden = np.flatnonzero(truth.visible), np.flatnonzero(~truth.visible)
    found = match_centers(centers, truth.centers[visible], reach)
    pairs = Matching(found.predicted, visible[found.true], found.distances)
    left = np.setdiff1d(np.arange(len(centers)), pairs.predicted)
    ignored = left[match_centers(centers[left], truth.centers[hidden], reach).predicted]
    rest = np.setdiff1d(left, ignored)
    double = _find_within(centers[rest], truth.centers, np.full(len(truth.centers), reach))
    unmatched = np.setdiff1d(visible, pairs.true)
    reaches = np.maximum(reach, diameters[pairs.predicted] / 2.0)
    merged = _find_within(truth.centers[unmatched], centers[pairs.predicted], reaches)
    return Judgement(
        radius=radius,
        diameters=diameters,
        pairs=pairs,
        ignored=np.sort(ignored),
        doubles=rest[double],
        false=rest[~double],
        merged=unmatched[merged],
        missed=unmatched[~merged],
    )


def _find_within(points: FloatArray, centers: FloatArray, reaches: FloatArray) -> NDArray[np.bool_]:
    """Find whether each of the points (A, 3) lies within its reach (B,) of any centre (B, 3)."""
    inside = np.zeros(len(points), bool)
    inside[pairs_within(points, centers, reaches)[0]] = True
    return inside
