"""A whole orchard drawn from its seed, as plain values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config import OrchardConfig
from .fruiting import Fruiting, PlacedFruit
from .ground import Ground, lay_ground
from .meshes import Mesh, fruit_mesh
from .species import SPECIES, Species, Variant
from .tree import Branch, Leaves, grow, place_leaves

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Orchard:
    """A scene before it is rendered, as plain values. World frame: z up, metres."""

    config: OrchardConfig
    species: Species
    variant: Variant
    branches: tuple[Branch, ...]
    leaves: Leaves
    fruits: tuple[PlacedFruit, ...]
    fruit_meshes: tuple[Mesh, ...]
    ground: Ground

    @property
    def crown(self) -> FloatArray:
        """(2, 3) low and high corner around the leaves, without the outermost twentieth."""
        return np.percentile(self.leaves.bases, [2.5, 97.5], axis=0)


def plant(config: OrchardConfig) -> Orchard:
    """Draw the whole orchard from the seed. Each part has its own stream, so none disturbs another."""
    species = SPECIES[config.species]
    streams = [np.random.default_rng([config.seed, part]) for part in range(6)]
    names = [v.name for v in species.variants]
    variant = species.variants[names.index(config.variant) if config.variant else int(streams[0].integers(len(names)))]
    branches = grow(streams[1], species)
    ground = lay_ground(streams[2], size=species.tree_height / 2.3)
    fruiting = Fruiting(streams[3], species, branches)
    fruiting.hang(config.fruits)
    fruiting.drop(config.fallen, ground.relief, 0.42 * species.tree_height)
    fruits = tuple(fruiting.placed)
    leaves = _leaves_outside(place_leaves(streams[4], branches, species, int(config.leaves * 1.25)), fruits)
    return Orchard(
        config=config,
        species=species,
        variant=variant,
        branches=branches,
        leaves=_first(leaves, config.leaves),
        fruits=fruits,
        fruit_meshes=tuple(fruit_mesh(streams[5], f.body, variant) for f in fruits),
        ground=ground,
    )


def _leaves_outside(leaves: Leaves, fruits: tuple[PlacedFruit, ...]) -> Leaves:
    """The leaves whose midrib does not run through a fruit."""
    keep = np.ones(len(leaves.bases), dtype=bool)
    for fruit in fruits:
        for part in (0.3, 0.6, 0.9, 1.15):
            place = leaves.bases + part * leaves.lengths[:, None] * leaves.frames[:, :, 1]
            keep &= np.linalg.norm(place - fruit.body.center, axis=1) > 0.52 * fruit.diameter
    return _chosen(leaves, np.flatnonzero(keep))


def _chosen(leaves: Leaves, rows: NDArray[np.int64]) -> Leaves:
    return Leaves(
        bases=leaves.bases[rows], frames=leaves.frames[rows], lengths=leaves.lengths[rows], shades=leaves.shades[rows]
    )


def _first(leaves: Leaves, count: int) -> Leaves:
    return _chosen(leaves, np.arange(min(count, len(leaves.bases))))
