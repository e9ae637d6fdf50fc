"""The fruit placed so far, and collisions of a new one with them and the wood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..shapes.body import Body, measure_gap, measure_signed_distance
from ..shapes.branch import Branch, sample_wood

FloatArray = NDArray[np.float64]
OVERLAP = 0.005
"""How deep touching fruit may overlap, in fruit diameters."""
WIDEST = 0.06
"""More than the half thickness of any wood, metres."""


@dataclass(frozen=True, kw_only=True)
class PlacedFruit:
    """A fruit in the world."""

    id: int
    body: Body
    diameter: float
    """Diameter of the sphere of equal volume, metres."""
    kind: str
    """hanging, fallen or neighbour"""
    anchor: FloatArray | None
    """(3,) where its stalk meets the wood; None for fallen fruit."""
    clump: int
    """Shared by the fruit of one clump; 0 for fallen fruit."""
    tree: int = 1
    """Number of its tree in the row, from 1; 0 for a neighbour's fruit."""


class Crop:
    """Fruit placed one after another among the wood of some trees, each clear of everything placed before."""

    def __init__(self, branches: Sequence[Branch], first_id: int = 1) -> None:
        samples = sample_wood(branches)
        self.wood = samples[np.argsort(samples[:, 2], kind="stable")]
        """(M, 4) points on centre lines with the radius there, sorted by height."""
        self.first_id = first_id
        self.fruits: list[PlacedFruit] = []
        self._balls = np.zeros((64, 4))  # centre and reach of each fruit; grows by doubling

    def add(
        self, body: Body, diameter: float, *, kind: str, anchor: FloatArray | None, clump: int, tree: int
    ) -> PlacedFruit:
        """Place a fruit."""
        number = len(self.fruits)
        if number == len(self._balls):
            self._balls = np.vstack([self._balls, np.zeros_like(self._balls)])
        self._balls[number] = [*body.center, body.reach]
        fruit = PlacedFruit(
            id=self.first_id + number, body=body, diameter=diameter, kind=kind, anchor=anchor, clump=clump, tree=tree
        )
        self.fruits.append(fruit)
        return fruit

    def is_clear(self, body: Body, diameter: float) -> bool:
        """Whether the body is clear of wood and of every placed fruit, except for touching."""
        reach = body.reach + WIDEST
        low, high = np.searchsorted(self.wood[:, 2], [body.center[2] - reach, body.center[2] + reach])
        near = self.wood[low:high]
        near = near[((near[:, :3] - body.center) ** 2).sum(axis=1) < reach**2]
        if len(near) and (measure_signed_distance(body, near[:, :3]) - near[:, 3]).min() < 0.0:
            return False
        balls = self._balls[: len(self.fruits)]
        close = ((balls[:, :3] - body.center) ** 2).sum(axis=1) <= (balls[:, 3] + body.reach) ** 2
        others = [self.fruits[i] for i in np.flatnonzero(close)]
        return all(measure_gap(o.body, body) >= -OVERLAP * min(diameter, o.diameter) for o in others)
