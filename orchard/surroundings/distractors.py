"""Objects that are easily mistaken for fruit: tags on twigs and fruit-coloured flowers. Plain arrays, no Blender."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..plants.crop import PlacedFruit
from ..plants.foliage import Leaves
from ..shapes.branch import Branch, to_unit
from ..shapes.ground import Ground
from ..shapes.meshes import Mesh
from ..species import Species, Variant, linear_rgb

FloatArray = NDArray[np.float64]
TAG_COLORS = ("#d8261c", "#f2c511", "#f4f2ea", "#2a62c8", "#f07a1a", "#e0388a")
PETALS = 5


def hang_tags(rng: np.random.Generator, branches: Sequence[Branch], count: int) -> list[Mesh]:
    """Cards of about 3 by 6 cm that hang on strings from the outer twigs."""
    twigs = [b for b in branches if b.generation >= 2 and b.points[-1][2] > 0.3]
    tags = []
    for _ in range(count):
        place, _ = twigs[int(rng.integers(len(twigs)))].at(float(rng.uniform(0.6, 0.95)))
        wide, long, string = rng.uniform(0.012, 0.018), rng.uniform(0.045, 0.07), rng.uniform(0.01, 0.05)
        turn, lean = rng.uniform(0, 2 * np.pi), rng.normal(0.0, 0.15, 2)
        down = to_unit(np.array([*lean, -1.0]))
        side = to_unit(np.cross(down, [np.cos(turn), np.sin(turn), 0.0]))
        top = place + string * down
        card = [top - wide * side, top + wide * side, top + wide * side + long * down, top - wide * side + long * down]
        cord = [place - 0.001 * side, place + 0.001 * side, top + 0.001 * side, top - 0.001 * side]
        color = linear_rgb(TAG_COLORS[int(rng.integers(len(TAG_COLORS)))]) * rng.uniform(0.8, 1.0)
        tags.append(
            Mesh(
                vertices=np.array([*card, *cord]),
                quads=np.array([[0, 1, 2, 3], [4, 5, 6, 7]]),
                colors=np.vstack([np.tile(color, (4, 1)), np.full((4, 3), 0.6)]),
            )
        )
    return tags


def make_flower_prototype(rng: np.random.Generator, variant: Variant) -> Mesh:
    """Make a flat blossom of radius 1 that faces +z, in the colours of the fruit, with a small yellow heart."""
    turns = np.linspace(0, 2 * np.pi, 8 * PETALS, endpoint=False)
    edge = 0.62 + 0.38 * np.abs(np.sin(PETALS * turns / 2 + rng.uniform(0, 6.28)))
    rings = [np.zeros(len(turns)), np.full(len(turns), 0.2), 0.65 * edge, edge]
    heights = [0.05, 0.05, 0.1, 0.22 + 0.05 * rng.normal()]
    vertices = np.vstack(
        [
            np.stack([r * np.cos(turns), r * np.sin(turns), np.full(len(turns), h)], axis=1)
            for r, h in zip(rings, heights, strict=True)
        ]
    )
    n = len(turns)
    ring, after = np.arange(n), np.roll(np.arange(n), -1)
    quads = np.vstack(
        [np.stack([k * n + ring, k * n + n + ring, k * n + n + after, k * n + after], 1) for k in range(3)]
    )
    skin = [linear_rgb(c) for c in (variant.top, variant.middle, variant.blush)]
    petal = skin[int(rng.integers(len(skin)))] * rng.uniform(0.85, 1.2)
    shades = [linear_rgb("#c9a227"), 0.8 * petal, petal, np.minimum(1.15 * petal, 1.0)]
    return Mesh(vertices=vertices, quads=quads, colors=np.clip(np.repeat(np.array(shades), n, axis=0), 0, 1))


def scatter_flowers(
    rng: np.random.Generator,
    species: Species,
    variant: Variant,
    leaves: Leaves,
    fruits: Sequence[PlacedFruit],
    ground: Ground,
    count: int,
    x0: float,
) -> list[Mesh]:
    """Half of the flowers in the crown, clear of the fruit, and half in the grass around the trunk at x = x0."""
    flowers: list[Mesh] = []
    size = species.tree_height / 2.3
    in_crown = count // 2 if len(leaves.bases) else 0
    centers = np.array([f.body.center for f in fruits]).reshape(-1, 3)
    reaches = np.array([f.body.reach for f in fruits])
    for tries in itertools.count():
        if len(flowers) == count:
            break
        if tries > 20 * count:  # a crown full of fruit has no room for more
            in_crown = 0
        radius = species.diameter * rng.uniform(0.35, 0.6)
        if len(flowers) < in_crown:
            foot = leaves.bases[int(rng.integers(len(leaves.bases)))]
            facing = to_unit((foot - [x0, 0, foot[2]]) + [0, 0, 0.1 * size] + 0.2 * size * rng.normal(size=3))
            place = foot + 1.2 * radius * facing
            if len(fruits) and (np.linalg.norm(centers - place, axis=1) < reaches + radius).any():
                continue
        else:
            turn, away = rng.uniform(0, 2 * np.pi), size * rng.uniform(0.4, 2.0)
            x, y = x0 + away * np.cos(turn), away * np.sin(turn)
            facing = to_unit(np.array([0.0, 0.0, 1.0]) + 0.35 * rng.normal(size=3))
            place = np.array([x, y, float(ground.relief(x, y)) + rng.uniform(0.03, 0.12)])
        flowers.append(_place(make_flower_prototype(rng, variant), place, facing, radius))
    return flowers


def _place(flower: Mesh, place: FloatArray, facing: FloatArray, radius: float) -> Mesh:
    side = to_unit(np.cross(facing, [0.31, 0.95, 0.07]))
    frame = np.stack([side, np.cross(facing, side), facing], axis=1)
    return replace(flower, vertices=place + radius * flower.vertices @ frame.T)
