"""A whole orchard generated from its seed, as plain values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .cameras.aim import Part, choose_part
from .cameras.camera_path import Place
from .config import OrchardConfig
from .plants.crop import Crop, PlacedFruit
from .plants.foliage import Leaves, keep_outside, place_leaves
from .plants.fruiting import Fruiting, Habit
from .plants.tree import grow
from .shapes.branch import Branch
from .shapes.ground import Ground, lay_ground
from .shapes.meshes import Mesh, make_fruit_mesh
from .species import SPECIES, Species, Variant
from .surroundings.distractors import hang_tags, scatter_flowers
from .surroundings.neighbours import Neighbour, Prototype, plant_neighbours
from .surroundings.objects import scatter_objects
from .surroundings.things import SceneObject, place_objects

FloatArray = NDArray[np.float64]
SPACING = {"spindle": 1.75, "wall": 2.1, "vase": 2.3, "bush": 2.2}
"""Distance between trunks of a row, for a tree of 2.3 m."""


@dataclass(frozen=True, kw_only=True)
class Orchard:
    """A scene before it is rendered, as plain values. World frame: z up, metres; the row runs along x through 0."""

    config: OrchardConfig
    species: Species
    """With the configured tree's height."""
    variant: Variant
    branches: tuple[Branch, ...]
    """Branches of all trees of the row."""
    leaves: Leaves
    fruits: tuple[PlacedFruit, ...]
    """Fruit of the row's trees, hanging and fallen, then of the neighbours; ids count from 1."""
    fruit_meshes: tuple[Mesh, ...]
    """One per fruit of the row."""
    ground: Ground
    place: Place
    tags: tuple[Mesh, ...]
    flowers: tuple[Mesh, ...]
    things: tuple[SceneObject, ...]
    prototypes: tuple[Prototype, ...]
    neighbours: tuple[Neighbour, ...]

    @property
    def size(self) -> float:
        """Height of the trees over 2.3 m."""
        return self.species.tree_height / 2.3

    @property
    def world_meshes(self) -> list[Mesh]:
        """One per fruit, in the world."""
        far = [mesh for n in self.neighbours for mesh in n.world_meshes(self.prototypes[n.prototype])]
        return [*self.fruit_meshes, *far]


def plant(config: OrchardConfig) -> Orchard:
    """Generate the whole orchard from the seed. Each part has its own random stream, so parts do not affect each
    other."""
    species = species_of(config)
    streams = [np.random.default_rng([config.seed, part]) for part in (*range(9), 11, 12)]
    names = [v.name for v in species.variants]
    variant = species.variants[names.index(config.variant) if config.variant else int(streams[0].integers(len(names)))]
    size = species.tree_height / 2.3
    spacing = SPACING[config.form] * size
    feet = spacing * (np.arange(config.trees) - (config.trees - 1) / 2)
    half_row = float(feet[-1])
    ground = lay_ground(streams[2], size=size, half_row=half_row, posts=config.posts)
    trees = [_move(grow(streams[1], species, config.form), x) for x in feet]
    part = choose_part(streams[7], config, species, trees[0])
    fruits = _bear(streams[3], config, species, trees, feet, ground, part)
    leaves = [_grow_foliage(streams[4], config, species, tree, x, fruits) for tree, x in zip(trees, feet, strict=True)]
    crown = _find_crown(leaves, trees)
    place = Place(crown=crown, half_row=half_row, part=part)
    prototypes, neighbours = plant_neighbours(streams[8], config, species, variant, place, spacing, len(fruits) + 1)
    far = [f for n in neighbours for f in n.fruits(prototypes[n.prototype])]
    decor = streams[6]
    return Orchard(
        config=config,
        species=species,
        variant=variant,
        branches=tuple(branch for tree in trees for branch in tree),
        leaves=_join(leaves),
        fruits=(*fruits, *far),
        fruit_meshes=tuple(make_fruit_mesh(streams[5], f.body, variant) for f in fruits),
        ground=ground,
        place=place,
        tags=tuple(tag for tree in trees for tag in hang_tags(decor, tree, config.tags)),
        flowers=tuple(
            flower
            for these, x in zip(leaves, feet, strict=True)
            for flower in scatter_flowers(decor, species, variant, these, fruits, ground, config.flowers, float(x))
        ),
        things=tuple(
            thing
            for tree, x in zip(trees, feet, strict=True)
            for thing in (
                *place_objects(streams[9], tree, ground, size, config.things, float(x)),
                *scatter_objects(streams[10], tree, fruits, ground, size, species.diameter, config.objects, float(x)),
            )
        ),
        prototypes=prototypes,
        neighbours=neighbours,
    )


def species_of(config: OrchardConfig) -> Species:
    """The configured species with the configured height of its tree."""
    species = SPECIES[config.species]
    return replace(species, tree_height=config.tree_height) if config.tree_height else species


def _move(branches: Sequence[Branch], x: float) -> tuple[Branch, ...]:
    return tuple(replace(b, points=b.points + [x, 0.0, 0.0]) for b in branches)


def _bear(
    rng: np.random.Generator,
    config: OrchardConfig,
    species: Species,
    trees: Sequence[Sequence[Branch]],
    feet: FloatArray,
    ground: Ground,
    part: Part | None,
) -> list[PlacedFruit]:
    """The fruit of every tree of the row: first all hanging ones, then all fallen ones."""
    crop = Crop([branch for tree in trees for branch in tree])
    habit = Habit(clump=config.clump, spread=config.spread)
    if part is not None:
        habit = replace(habit, middle=part.center, reach=0.8 * part.reach)
    bearers = [Fruiting(rng, species, tree, crop, habit=habit, tree=i) for i, tree in enumerate(trees, start=1)]
    for bearer in bearers:
        bearer.hang(config.hanging)
    for bearer, x in zip(bearers, feet, strict=True):
        bearer.drop(config.fallen, ground.relief, 0.42 * species.tree_height, float(x))
    return crop.fruits


def _grow_foliage(
    rng: np.random.Generator,
    config: OrchardConfig,
    species: Species,
    tree: Sequence[Branch],
    x: float,
    fruits: Sequence[PlacedFruit],
) -> Leaves:
    """Grow the leaves of the tree, none through a fruit."""
    leaves = place_leaves(rng, _move(tree, -x), species, int(config.leaves * 1.25)).move(np.array([x, 0.0, 0.0]))
    centers = np.array([f.body.center for f in fruits]).reshape(-1, 3)
    free = keep_outside(leaves, centers, np.array([f.diameter for f in fruits]))
    return free.select(np.arange(min(config.leaves, len(free.bases))))


def _join(leaves: Sequence[Leaves]) -> Leaves:
    return Leaves(
        bases=np.concatenate([each.bases for each in leaves]),
        frames=np.concatenate([each.frames for each in leaves]),
        lengths=np.concatenate([each.lengths for each in leaves]),
        shades=np.concatenate([each.shades for each in leaves]),
    )


def _find_crown(leaves: Sequence[Leaves], trees: Sequence[Sequence[Branch]]) -> FloatArray:
    """Find the low and high corner (2, 3) around the crowns, without the outermost twentieth of each."""
    bare = [np.vstack([b.points for b in tree if b.generation >= 2]) for tree in trees]
    places = [e.bases if len(e.bases) >= 100 else wood for e, wood in zip(leaves, bare, strict=True)]
    corners = np.array([np.percentile(p, [2.5, 97.5], axis=0) for p in places])
    return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])
