"""Positions of the fruit: single or in touching clumps, clear of the wood and of each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import OrchardError
from ..shapes.body import Body, measure_gap, normalise_profile, smooth_profile
from ..shapes.branch import Branch, to_unit
from ..shapes.ground import HeightField
from ..species import Species
from .crop import OVERLAP, Crop, PlacedFruit

FloatArray = NDArray[np.float64]
DOWN = np.array([0.0, 0.0, -1.0])
LARGEST_CLUMP = 12


@dataclass(frozen=True, kw_only=True)
class Habit:
    """Differences of a tree from its species."""

    clump: float = 0.0
    """Mean clump size; 0: the species' own."""
    spread: float = -1.0
    """Standard deviation of the diameter over its mean; below 0: the species' own."""
    middle: FloatArray | None = None
    """(3,) where the fruit gather; None: all over the crown."""
    reach: float = 0.0
    """Distance from the middle within which most of them hang, metres."""


class Fruiting:
    """Places the hanging and fallen fruit of one tree."""

    def __init__(
        self,
        rng: np.random.Generator,
        species: Species,
        branches: Sequence[Branch],
        crop: Crop | None = None,
        *,
        habit: Habit = Habit(),
        tree: int = 1,
    ) -> None:
        self.rng = rng
        self.species = species
        self.habit = habit
        self.tree = tree
        self.crop = crop or Crop(branches)
        self.profile = smooth_profile(species.profile, 22)
        self.spurs = self._sample_spurs(branches)
        self.bearing = self._weigh_spurs()

    def _sample_spurs(self, branches: Sequence[Branch]) -> FloatArray:
        """Sample places (S, 3) on limbs, branches and twigs from which fruit may hang."""
        places = []
        for branch in branches:
            if branch.generation == 0:
                continue
            low = 0.35 if branch.generation == 1 else 0.15
            number = max(1, round(branch.span / (1.2 * self.species.diameter)))
            places += [branch.at(float(f))[0] for f in self.rng.uniform(low, 0.98, number)]
        spurs = np.array(places)
        clearance = 1.2 * self.species.diameter + 0.12 * self.species.tree_height
        return spurs[spurs[:, 2] > clearance]

    def _weigh_spurs(self) -> FloatArray:
        """Return the probability (S,) of each spur for the next clump."""
        weights = np.ones(len(self.spurs))
        if self.habit.middle is not None:
            away = np.linalg.norm(self.spurs - self.habit.middle, axis=1)
            weights = np.exp(-0.5 * (away / self.habit.reach) ** 2) + 1e-9
        return weights / max(weights.sum(), 1e-12)

    def _make_body(self, center: FloatArray, axis: FloatArray) -> tuple[Body, float]:
        """Make a fruit of random size and slightly random shape."""
        spread = self.habit.spread if self.habit.spread >= 0 else self.species.spread
        low, high = min(0.7, max(0.35, 1 - 2.5 * spread)), max(1.35, 1 + 2.5 * spread)
        diameter = self.species.diameter * float(np.clip(self.rng.normal(1.0, spread), low, high))
        shape = normalise_profile(self.profile * [float(np.clip(self.rng.normal(1.0, 0.05), 0.88, 1.12)), 1.0])
        return Body(center=center, axis=to_unit(axis), profile=shape * diameter), diameter

    def _hang(self, spur: FloatArray) -> tuple[Body, float]:
        axis = to_unit(-DOWN + self.rng.normal(0.0, 0.22, 3))
        body, diameter = self._make_body(np.zeros(3), axis)
        stalk = self.rng.uniform(*self.species.stalk)
        top = spur + stalk * to_unit(DOWN + self.rng.normal(0.0, 0.35, 3))
        return Body(center=top - axis * body.profile[0, 0], axis=axis, profile=body.profile), diameter

    def _nestle(self, neighbour: PlacedFruit) -> tuple[Body, float]:
        """A fruit that touches its neighbour from the side: moved outward until it just touches."""
        rng = self.rng
        axis = to_unit(-DOWN + rng.normal(0.0, 0.28, 3))
        body, diameter = self._make_body(np.zeros(3), axis)
        heading = to_unit(rng.normal(0.0, 1.0, 3) * [1.0, 1.0, 0.45])
        near, far = 0.0, body.reach + neighbour.body.reach
        for _ in range(11):
            middle = 0.5 * (near + far)
            trial = Body(center=neighbour.body.center + middle * heading, axis=axis, profile=body.profile)
            if measure_gap(neighbour.body, trial) < -0.6 * OVERLAP * diameter:
                near = middle
            else:
                far = middle
        return Body(center=neighbour.body.center + far * heading, axis=axis, profile=body.profile), diameter

    def _sample_clump_size(self) -> int:
        if self.habit.clump > 0:
            return min(1 + int(self.rng.poisson(self.habit.clump - 1)), LARGEST_CLUMP)
        weights = np.array(self.species.clump_sizes)
        return int(self.rng.choice(np.arange(1, len(weights) + 1), p=weights / weights.sum()))

    def hang(self, count: int) -> None:
        """Hang `count` fruit, clump after clump; raises OrchardError if the tree has no room for them."""
        clump = max((f.clump for f in self.crop.fruits), default=0)
        hung, failures = 0, 0
        while hung < count:
            if failures > 800 or not len(self.spurs):
                raise OrchardError(
                    f"Only {hung} of {count} fruit find room on this tree: ask for fewer, or for a greater tree_height"
                )
            spur = self.spurs[self.rng.choice(len(self.spurs), p=self.bearing)]
            body, diameter = self._hang(spur)
            if not self.crop.is_clear(body, diameter):
                failures += 1
                continue
            clump, failures = clump + 1, 0
            hung += self._fill_clump(body, diameter, spur, clump, min(self._sample_clump_size(), count - hung))

    def _fill_clump(self, body: Body, diameter: float, spur: FloatArray, clump: int, size: int) -> int:
        """Hang a clump's first fruit at its spur and the others next to it; returns how many found room."""
        members = [self.crop.add(body, diameter, kind="hanging", anchor=spur, clump=clump, tree=self.tree)]
        for _ in range(12 * size):
            if len(members) == size:
                break
            body, diameter = self._nestle(members[int(self.rng.integers(len(members)))])
            anchor = self._find_anchor(body, spur)
            if anchor is not None and self.crop.is_clear(body, diameter):
                fruit = self.crop.add(body, diameter, kind="hanging", anchor=anchor, clump=clump, tree=self.tree)
                members.append(fruit)
        return len(members)

    def _find_anchor(self, body: Body, spur: FloatArray) -> FloatArray | None:
        """Find the wood near the stalk end of the body, no farther than a long stalk; else the clump's own spur; else
        None."""
        above = self.crop.wood[:, :3]
        distance = np.linalg.norm(above - body.top, axis=1) + 0.03 * (above[:, 2] < body.top[2])
        longest = 1.5 * self.species.stalk[1] + 0.25 * self.species.diameter
        best = int(distance.argmin())
        if distance[best] < longest:
            return above[best]
        # The inner fruit of a large clump push the outer ones away from the wood.
        allowed = 1.6 * longest + 0.25 * max(self.habit.clump - 2, 0) * self.species.diameter
        return spur if np.linalg.norm(spur - body.top) < allowed else None

    def drop(self, count: int, ground_height: HeightField, radius: float, x0: float = 0.0) -> None:
        """Lay `count` fruit on the ground within `radius` of the trunk at x = x0 and y = 0.

        Raises:
            OrchardError: the ground has no room for them.
        """
        fallen, tries = 0, 0
        while fallen < count:
            if tries > 50 * count + 200:
                raise OrchardError(f"Only {fallen} of {count} fallen fruit find room under this tree: ask for fewer")
            tries += 1
            turn, away = self.rng.uniform(0, 2 * np.pi), radius * np.sqrt(self.rng.uniform(0.1, 1.0))
            x, y = x0 + away * np.cos(turn), away * np.sin(turn)
            lying = to_unit(self.rng.normal(size=3) * [1, 1, 0.5])
            body, diameter = self._make_body(np.zeros(3), lying)
            center = np.array([x, y, ground_height(x, y) - _find_lowest(body) - 0.03 * diameter])
            body = Body(center=center, axis=body.axis, profile=body.profile)
            if self.crop.is_clear(body, diameter):
                self.crop.add(body, diameter, kind="fallen", anchor=None, clump=0, tree=self.tree)
                fallen += 1


def _find_lowest(body: Body) -> float:
    """Find the height of the body's lowest point relative to its centre."""
    z, r = body.profile[:, 0], body.profile[:, 1]
    return float((z * body.axis[2] - r * np.sqrt(max(0.0, 1 - body.axis[2] ** 2))).min())
