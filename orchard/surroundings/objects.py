"""Objects that no word names: random shapes, patterns and colours. Plain arrays, no Blender.

An encoder that has seen only fruit, plants and tools takes every other round object for a fruit.
"""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..plants.crop import PlacedFruit
from ..shapes.branch import Branch, to_unit
from ..shapes.ground import Ground
from ..shapes.meshes import Mesh, grid_quads, make_tube
from .things import SceneObject, choose_spot

FloatArray = NDArray[np.float64]

WORD = "object"
ROWS, COLUMNS = 40, 48
"""Vertices of a surface, along and around its axis: enough to carry a pattern."""
SIZES = (0.6, 3.0)
"""Longest side over the diameter of the scene's fruit."""
HANGING = 0.6
"""Share that hangs in the crown; the rest lies on the ground."""
TRIES = 40
"""Places tried for an object before it is left out: a crown full of fruit has no room."""


def scatter_objects(
    rng: np.random.Generator,
    branches: Sequence[Branch],
    fruits: Sequence[PlacedFruit],
    ground: Ground,
    size: float,
    diameter: float,
    count: int,
    x0: float,
) -> list[SceneObject]:
    """This many objects in the crown and around the trunk at x = x0 of a tree of height 2.3 m times `size`, clear of
    the fruit, whose mean diameter is given in metres."""
    centers = np.array([f.body.center for f in fruits]).reshape(-1, 3)
    reaches = np.array([f.body.reach for f in fruits])
    twigs = [b for b in branches if b.generation >= 2 and b.points[-1][2] > 0.3]
    objects: list[SceneObject] = []
    for _ in range(TRIES * count):
        if len(objects) == count:
            break
        reach = 0.5 * diameter * float(np.exp(rng.uniform(*np.log(SIZES))))
        if rng.random() < HANGING:
            place, _ = twigs[int(rng.integers(len(twigs)))].at(float(rng.uniform(0.6, 1.0)))
            outward = to_unit(place - [x0, 0.0, place[2]]) - [0.0, 0.0, 1.0]
            place = place + rng.uniform(0.6, 1.6) * reach * outward
        else:
            place = choose_spot(rng, ground, size, x0, 0.1, 1.0) + [0.0, 0.0, 0.7 * reach]
        if len(fruits) and (np.linalg.norm(centers - place, axis=1) < reaches + reach).any():
            continue
        gloss = float(rng.uniform(0.02, 0.25)) if rng.random() < 0.6 else 0.0
        objects.append(SceneObject(word=WORD, mesh=_place(rng, _make_object(rng), place, reach), gloss=gloss))
    return objects


def _make_object(rng: np.random.Generator) -> Mesh:
    """Make a coloured object around the origin, not larger than a ball of radius 1."""
    shapes = (_make_superellipsoid, _make_superellipsoid, _make_lathed, _make_bent, _make_ring)
    vertices, is_ball = shapes[int(rng.integers(len(shapes)))](rng)
    vertices = vertices - (vertices.max(axis=0) + vertices.min(axis=0)) / 2.0
    vertices = vertices / np.linalg.norm(vertices, axis=1).max()
    quads = grid_quads(len(vertices) // COLUMNS, COLUMNS, wrap=True)
    return Mesh(vertices=vertices, quads=quads, colors=make_pattern(rng, vertices, is_ball=is_ball))


def _make_superellipsoid(rng: np.random.Generator) -> tuple[FloatArray, bool]:
    """Make any shape from a box over a ball to an octahedron; whether it is about a ball."""
    upright, around = np.exp(rng.uniform(np.log(0.15), np.log(2.5), 2)) if rng.random() < 0.7 else (1.0, 1.0)
    sides = np.exp(rng.uniform(-0.7, 0.7, 3)) if rng.random() < 0.6 else np.ones(3)
    rise, turn = np.linspace(-np.pi / 2, np.pi / 2, ROWS)[:, None], np.linspace(0, 2 * np.pi, COLUMNS, endpoint=False)
    grid = np.stack(
        [
            _signed_power(np.cos(rise), upright) * _signed_power(np.cos(turn), around),
            _signed_power(np.cos(rise), upright) * _signed_power(np.sin(turn), around),
            np.broadcast_to(_signed_power(np.sin(rise), upright), (ROWS, COLUMNS)),
        ],
        axis=2,
    ).reshape(-1, 3)
    is_ball = 0.6 < upright < 1.5 and 0.6 < around < 1.5 and sides.max() < 1.6 * sides.min()
    return grid * sides, bool(is_ball)


def _make_lathed(rng: np.random.Generator) -> tuple[FloatArray, bool]:
    """Make a bottle, bell, cone or vase: a random profile turned about its axis."""
    knots = rng.uniform(0.15, 1.0, 5)
    along = np.linspace(0.0, 1.0, ROWS)
    radii = np.interp(along, np.linspace(0.0, 1.0, 5), knots)
    radii = np.convolve(np.pad(radii, 3, mode="edge"), np.ones(7) / 7.0, mode="valid")
    radii[[0, -1]] = 0.0
    turns = np.linspace(0, 2 * np.pi, COLUMNS, endpoint=False)
    long = rng.uniform(1.6, 4.0)
    rings = [
        np.stack([r * np.cos(turns), r * np.sin(turns), np.full(COLUMNS, long * z)], 1)
        for z, r in zip(along, radii, strict=True)
    ]
    return np.concatenate(rings), False


def _make_bent(rng: np.random.Generator) -> tuple[FloatArray, bool]:
    """Make a sausage or banana."""
    arc = np.linspace(-0.5, 0.5, ROWS) * rng.uniform(0.2, 2.6)
    along = np.linspace(-1.0, 1.0, ROWS)
    radii = rng.uniform(0.08, 0.25) * np.clip(1.0 - np.abs(along) ** rng.uniform(2.0, 8.0), 0.0, 1.0) ** 0.5
    line = np.stack([np.cos(arc), np.sin(arc), np.zeros(ROWS)], axis=1) / max(np.ptp(arc), 0.2)
    return make_tube(line, radii, segments=COLUMNS).vertices, False


def _make_ring(rng: np.random.Generator) -> tuple[FloatArray, bool]:
    """Make a ring, thick or thin."""
    turns = np.linspace(0, 2 * np.pi, ROWS)
    line = np.stack([np.cos(turns), np.sin(turns), np.zeros(ROWS)], axis=1)
    return make_tube(line, np.full(ROWS, rng.uniform(0.1, 0.45)), segments=COLUMNS).vertices, False


def _signed_power(values: FloatArray, exponent: float) -> FloatArray:
    return np.sign(values) * np.abs(values) ** exponent


def make_pattern(rng: np.random.Generator, vertices: FloatArray, *, is_ball: bool) -> FloatArray:
    """Make colours (V, 3), linear RGB: plain, shaded, striped, spotted or in patches.

    A ball in colours of fruit would be a fruit, so one of its colours is another.
    """
    kind = int(rng.integers(5))
    first, third = (_paint(rng, fruit_like=not (is_ball and kind < 2)) for _ in range(2))
    second = _paint(rng, fruit_like=not is_ball)
    along = vertices @ to_unit(rng.normal(size=3))
    if kind == 0:
        share = np.zeros(len(vertices))
    elif kind == 1:
        share = (along + 1.0) / 2.0
    elif kind == 2:
        share = (np.sin(rng.uniform(4.0, 16.0) * along + rng.uniform(0, 6.28)) > rng.uniform(-0.5, 0.5)).astype(float)
    elif kind == 3:
        share = (_make_waves(rng, vertices, rng.uniform(4.0, 10.0)) > rng.uniform(0.3, 1.2)).astype(float)
    else:
        cells = np.floor(vertices * rng.uniform(1.5, 5.0) + rng.uniform(0, 1, 3)).sum(axis=1)
        share = cells % 2.0
    colors = first + (second - first) * share[:, None]
    if kind >= 2 and rng.random() < 0.4:
        colors = np.where((_make_waves(rng, vertices, 3.0) > 1.0)[:, None], third, colors)
    return np.clip(colors * np.exp(rng.normal(0.0, 0.04, (len(vertices), 1))), 0.0, 1.0)


def _paint(rng: np.random.Generator, *, fruit_like: bool) -> FloatArray:
    """Linear RGB of any hue; without colours of fruit: blue to magenta, white, grey or black."""
    if fruit_like:
        hue, saturation = rng.random(), rng.uniform(0.0, 1.0)
    elif rng.random() < 0.5:
        hue, saturation = rng.uniform(0.48, 0.86), rng.uniform(0.5, 1.0)
    else:
        hue, saturation = rng.random(), rng.uniform(0.0, 0.12)
    value = rng.uniform(0.05, 1.0) if saturation < 0.15 else rng.uniform(0.35, 1.0)
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value)) ** 2.2


def _make_waves(rng: np.random.Generator, vertices: FloatArray, frequency: float) -> FloatArray:
    """Make (V,) a smooth random field of mean 0 and standard deviation about 1."""
    parts = [np.sin(vertices @ rng.normal(0.0, frequency, 3) + rng.uniform(0, 6.28)) for _ in range(4)]
    return np.sum(parts, axis=0) / np.sqrt(2.0)


def _place(rng: np.random.Generator, mesh: Mesh, place: FloatArray, reach: float) -> Mesh:
    """Place the mesh, rotated at random, `reach` metres from its middle to its farthest point."""
    frame, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Mesh(vertices=place + reach * mesh.vertices @ frame.T, quads=mesh.quads, colors=mesh.colors)
