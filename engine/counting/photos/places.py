"""Places where fruit may be, each with its own radius."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.overlaps import Overlaps

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


def keep_strongest(places: Places, strengths: FloatArray, share: float) -> IntArray:
    """Choose which places to keep, the strongest (C,) first, so that the centres of no two are nearer than `share` of
    the sum of their radii."""
    overlaps, kept = Overlaps.of(places.centers, places.radii, share), list[int]()
    for index in np.argsort(-strengths, kind="stable").tolist():
        if not overlaps.any_chosen(index):
            overlaps.chosen[index] = True
            kept.append(index)
    return np.array(kept, np.int64)


def find_clear(places: Places, others: Places, share: float) -> NDArray[np.bool_]:
    """Find which places (C,) keep `share` of the sum of both radii from all others."""
    overlaps = Overlaps.of(others.centers, others.radii, share)
    overlaps.chosen[:] = True
    return np.array([not overlaps.any_near(*each) for each in zip(places.centers, places.radii, strict=True)], bool)
