"""The rows behind and in front: copies of a few trees with fruit that do not belong to the count."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera_path import Place, distance_from_row
from ..config import ALONG, OrchardConfig
from ..plants.crop import Crop, PlacedFruit
from ..plants.foliage import Leaves, keep_outside, place_leaves
from ..plants.fruiting import Fruiting, Habit
from ..plants.tree import grow
from ..shapes.branch import Branch
from ..shapes.meshes import Mesh, make_fruit_mesh
from ..species import Species, Variant

FloatArray = NDArray[np.float64]
KINDS = 2
"""Trees that the neighbours are copies of."""
MOST_FRUITS, MOST_LEAVES = 80, 2400
"""On one neighbour."""


@dataclass(frozen=True, kw_only=True)
class Prototype:
    """A tree with its foot at the origin, that several neighbours are copies of."""

    branches: tuple[Branch, ...]
    leaves: Leaves
    fruits: tuple[PlacedFruit, ...]
    fruit_meshes: tuple[Mesh, ...]


@dataclass(frozen=True, kw_only=True)
class Neighbour:
    """A copy of a prototype."""

    prototype: int
    foot: FloatArray
    """(3,) metres."""
    turn: float
    """About its trunk, radians."""
    first_id: int
    """Id of its first fruit; the others follow."""

    @property
    def frame(self) -> FloatArray:
        """(3, 3) rotation from the prototype's frame to the world's."""
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def fruits(self, prototype: Prototype) -> list[PlacedFruit]:
        """Its fruit in the world."""
        return [
            replace(
                fruit,
                id=self.first_id + i,
                kind="neighbour",
                clump=0,
                tree=0,
                anchor=None,
                body=replace(
                    fruit.body, center=self.foot + self.frame @ fruit.body.center, axis=self.frame @ fruit.body.axis
                ),
            )
            for i, fruit in enumerate(prototype.fruits)
        ]

    def world_meshes(self, prototype: Prototype) -> list[Mesh]:
        """One a fruit, in the world."""
        return [replace(m, vertices=self.foot + m.vertices @ self.frame.T) for m in prototype.fruit_meshes]


def plant_neighbours(
    rng: np.random.Generator,
    config: OrchardConfig,
    species: Species,
    variant: Variant,
    place: Place,
    spacing: float,
    first_id: int,
) -> tuple[tuple[Prototype, ...], tuple[Neighbour, ...]]:
    """Prototypes and their copies in two rows beyond the camera path, nearest to the tree first."""
    prototypes = tuple(_make_prototype(rng, config, species, variant) for _ in range(min(KINDS, config.neighbours)))
    half_width = (place.crown[1] - place.crown[0])[1] / 2
    away = 1.06 * distance_from_row(species, place) + half_width + 0.3
    if config.path not in ALONG and place.part is None:
        away += place.half_row
    neighbours = []
    for i in range(config.neighbours):
        slot = (i // 2 + 1) // 2 * (1 if i // 2 % 2 else -1)
        foot = np.array([slot * spacing + rng.normal(0.0, 0.06) * spacing, away * (1 if i % 2 == 0 else -1), 0.0])
        turn = np.pi * rng.integers(2) if config.form == "wall" else rng.uniform(0, 2 * np.pi)
        kind = i % len(prototypes)
        neighbours.append(Neighbour(prototype=kind, foot=foot, turn=float(turn), first_id=first_id))
        first_id += len(prototypes[kind].fruits)
    return prototypes, tuple(neighbours)


def _make_prototype(rng: np.random.Generator, config: OrchardConfig, species: Species, variant: Variant) -> Prototype:
    branches = grow(rng, species, config.form)
    crop = Crop(branches)
    habit = Habit(clump=config.clump, spread=config.spread)
    Fruiting(rng, species, branches, crop, habit=habit).hang(min(config.fruits, MOST_FRUITS))
    count = min(config.leaves, MOST_LEAVES)
    leaves = place_leaves(rng, branches, species, int(count * 1.25))
    centers = np.array([f.body.center for f in crop.fruits]).reshape(-1, 3)
    leaves = keep_outside(leaves, centers, np.array([f.diameter for f in crop.fruits]))
    return Prototype(
        branches=branches,
        leaves=leaves.select(np.arange(min(count, len(leaves.bases)))),
        fruits=tuple(crop.fruits),
        fruit_meshes=tuple(make_fruit_mesh(rng, f.body, variant, segments=14) for f in crop.fruits),
    )
