"""Places where fruit may be, each with its own radius."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..geometry.matching import ROUNDING

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Places:
    """C spheres: centers (C, 3) and radii (C,), scene units."""

    centers: FloatArray
    radii: FloatArray

    def __len__(self) -> int:
        return len(self.radii)

    @property
    def largest(self) -> float:
        """The largest radius; 0 without places."""
        return float(self.radii.max(initial=0.0))

    def select(self, index: NDArray) -> Places:
        """The places at `index` (bool mask (C,) or integer indices)."""
        return Places(self.centers[index], self.radii[index])

    @staticmethod
    def join(parts: Sequence[Places]) -> Places:
        """The places of all parts, one after the other."""
        return Places(*(np.concatenate([getattr(each, name) for each in parts]) for name in ("centers", "radii")))

    @staticmethod
    def alike(centers: FloatArray, diameter: float) -> Places:
        """Places of one diameter at centers (C, 3)."""
        return Places(centers, np.full(len(centers), diameter / 2.0))


NO_PLACES = Places(np.zeros((0, 3)), np.zeros(0))


def apart(places: Places, strengths: FloatArray, share: float) -> IntArray:
    """Which places to keep, the strongest (C,) first, so that the centres of no two are nearer than `share` of the sum
    of their diameters divided by two."""
    near, kept, chosen = _near(places, places, share), np.zeros(len(places), bool), list[int]()
    for index in np.argsort(-strengths, kind="stable").tolist():
        if not kept[near[index]].any():
            kept[index] = True
            chosen.append(index)
    return np.array(chosen, np.int64)


def clear_of(places: Places, others: Places, share: float) -> NDArray[np.bool_]:
    """(C,) which places keep `share` of a mean diameter from all others, as in `apart`."""
    return np.array([len(each) == 0 for each in _near(places, others, share)], bool)


def _near(places: Places, others: Places, share: float) -> list[IntArray]:
    """Of each place which of the others are nearer than `share` of the sum of both radii."""
    if len(places) == 0 or len(others) == 0:
        return [np.zeros(0, np.int64)] * len(places)
    reach = ROUNDING * share * (places.radii + others.largest)
    found = cKDTree(others.centers).query_ball_point(places.centers, reach)
    near = []
    for center, radius, each in zip(places.centers, places.radii, found, strict=True):
        index = np.array(sorted(each), np.int64)
        between = np.linalg.norm(others.centers[index] - center, axis=1)
        near.append(index[between < share * (others.radii[index] + radius)])
    return near
