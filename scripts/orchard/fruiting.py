"""Where the fruit hang: singly and in touching clumps, clear of the wood and of each other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .body import Body, gap, normalised, signed_distance, smooth_profile
from .errors import OrchardError
from .ground import HeightField
from .species import Species
from .tree import Branch, unit, wood_samples

FloatArray = NDArray[np.float64]
DOWN = np.array([0.0, 0.0, -1.0])
OVERLAP = 0.005
"""How deep touching fruit may press into each other, in fruit diameters."""


@dataclass(frozen=True, kw_only=True)
class PlacedFruit:
    """A fruit in the world."""

    id: int
    body: Body
    diameter: float
    """Of the sphere of equal volume, metres."""
    kind: str
    """hanging or fallen"""
    anchor: FloatArray | None
    """(3,) where its stalk meets the wood; None for fallen fruit."""
    clump: int
    """Fruit of one clump share it."""


class Fruiting:
    """Places fruit one after another, each clear of everything placed before."""

    def __init__(self, rng: np.random.Generator, species: Species, branches: tuple[Branch, ...]) -> None:
        self.rng = rng
        self.species = species
        self.wood = wood_samples(branches)
        self.spurs = self._spurs(branches)
        self.profile = smooth_profile(species.profile, 22)
        self.placed: list[PlacedFruit] = []

    def _spurs(self, branches: tuple[Branch, ...]) -> FloatArray:
        """(S, 3) places on limbs, branches and twigs from which fruit may hang."""
        places = []
        for branch in branches:
            if branch.generation == 0:
                continue
            low = 0.35 if branch.generation == 1 else 0.15
            span = float(np.linalg.norm(np.diff(branch.points, axis=0), axis=1).sum())
            number = max(1, round(span / (1.2 * self.species.diameter)))
            places += [branch.at(float(f))[0] for f in self.rng.uniform(low, 0.98, number)]
        spurs = np.array(places)
        clearance = 1.2 * self.species.diameter + 0.12 * self.species.tree_height
        return spurs[spurs[:, 2] > clearance]

    def _body(self, center: FloatArray, axis: FloatArray) -> tuple[Body, float]:
        """A fruit of random size and slightly random shape."""
        diameter = self.species.diameter * float(np.clip(self.rng.normal(1.0, self.species.spread), 0.7, 1.35))
        shape = normalised(self.profile * [float(np.clip(self.rng.normal(1.0, 0.05), 0.88, 1.12)), 1.0])
        return Body(center=center, axis=unit(axis), profile=shape * diameter), diameter

    def _clear(self, body: Body, diameter: float, *, ignore: int = -1) -> bool:
        """Whether the body stands free of wood and of every placed fruit."""
        near = self.wood[np.linalg.norm(self.wood[:, :3] - body.center, axis=1) < body.reach + 0.06]
        if len(near) and (signed_distance(body, near[:, :3]) - near[:, 3]).min() < 0.0:
            return False
        for other in self.placed:
            if other.id == ignore:
                continue
            if np.linalg.norm(other.body.center - body.center) > other.body.reach + body.reach:
                continue
            if gap(other.body, body) < -OVERLAP * min(diameter, other.diameter):
                return False
        return True

    def _hang(self, spur: FloatArray) -> tuple[Body, float]:
        axis = unit(-DOWN + self.rng.normal(0.0, 0.22, 3))
        body, diameter = self._body(np.zeros(3), axis)
        stalk = self.rng.uniform(*self.species.stalk)
        top = spur + stalk * unit(DOWN + self.rng.normal(0.0, 0.35, 3))
        return Body(center=top - axis * body.profile[0, 0], axis=axis, profile=body.profile), diameter

    def _nestle(self, neighbour: PlacedFruit) -> tuple[Body, float]:
        """A fruit that touches its neighbour from the side: slid outward until it just rests on it."""
        rng = self.rng
        axis = unit(-DOWN + rng.normal(0.0, 0.28, 3))
        body, diameter = self._body(np.zeros(3), axis)
        heading = unit(rng.normal(0.0, 1.0, 3) * [1.0, 1.0, 0.45])
        near, far = 0.0, body.reach + neighbour.body.reach
        for _ in range(11):
            middle = 0.5 * (near + far)
            trial = Body(center=neighbour.body.center + middle * heading, axis=axis, profile=body.profile)
            if gap(neighbour.body, trial) < -0.6 * OVERLAP * diameter:
                near = middle
            else:
                far = middle
        return Body(center=neighbour.body.center + far * heading, axis=axis, profile=body.profile), diameter

    def _add(self, body: Body, diameter: float, *, kind: str, anchor: FloatArray | None, clump: int) -> PlacedFruit:
        fruit = PlacedFruit(
            id=len(self.placed) + 1, body=body, diameter=diameter, kind=kind, anchor=anchor, clump=clump
        )
        self.placed.append(fruit)
        return fruit

    def hang(self, count: int) -> None:
        """Hang `count` fruit, clump after clump; raises OrchardError when the tree has no room for them."""
        sizes = np.arange(1, len(self.species.clump_sizes) + 1)
        chances = np.array(self.species.clump_sizes) / sum(self.species.clump_sizes)
        clump, failures = 0, 0
        while len(self.placed) < count:
            if failures > 800 or not len(self.spurs):
                raise OrchardError(f"only {len(self.placed)} of {count} fruit find room on this tree: ask for fewer")
            spur = self.spurs[self.rng.integers(len(self.spurs))]
            body, diameter = self._hang(spur)
            if not self._clear(body, diameter):
                failures += 1
                continue
            clump, failures = clump + 1, 0
            size = min(int(self.rng.choice(sizes, p=chances)), count - len(self.placed))
            members = [self._add(body, diameter, kind="hanging", anchor=spur, clump=clump)]
            for _ in range(12 * size):
                if len(members) == size:
                    break
                neighbour = members[int(self.rng.integers(len(members)))]
                body, diameter = self._nestle(neighbour)
                anchor = self._anchor(body, spur)
                if anchor is not None and self._clear(body, diameter):
                    members.append(self._add(body, diameter, kind="hanging", anchor=anchor, clump=clump))

    def _anchor(self, body: Body, spur: FloatArray) -> FloatArray | None:
        """The wood near the body's stalk end, no farther than a long stalk; else the clump's own spur; else None."""
        above = self.wood[:, :3]
        distance = np.linalg.norm(above - body.top, axis=1) + 0.03 * (above[:, 2] < body.top[2])
        longest = 1.5 * self.species.stalk[1] + 0.25 * self.species.diameter
        best = int(distance.argmin())
        if distance[best] < longest:
            return above[best]
        return spur if np.linalg.norm(spur - body.top) < 1.6 * longest else None

    def drop(self, count: int, ground_height: HeightField, radius: float) -> None:
        """Lay `count` fruit on the ground under the crown."""
        tries = 0
        fallen = 0
        while fallen < count and tries < 50 * count:
            tries += 1
            turn, away = self.rng.uniform(0, 2 * np.pi), radius * np.sqrt(self.rng.uniform(0.1, 1.0))
            x, y = away * np.cos(turn), away * np.sin(turn)
            lying = unit(self.rng.normal(size=3) * [1, 1, 0.5])
            body, diameter = self._body(np.zeros(3), lying)
            lowest = self._lowest(body)
            center = np.array([x, y, ground_height(x, y) - lowest - 0.03 * diameter])
            body = Body(center=center, axis=body.axis, profile=body.profile)
            if self._clear(body, diameter):
                self._add(body, diameter, kind="fallen", anchor=None, clump=0)
                fallen += 1

    @staticmethod
    def _lowest(body: Body) -> float:
        """Height of the body's lowest point relative to its centre."""
        z, r = body.profile[:, 0], body.profile[:, 1]
        return float((z * body.axis[2] - r * np.sqrt(max(0.0, 1 - body.axis[2] ** 2))).min())
