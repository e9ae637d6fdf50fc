"""Objects found in orchards: buckets, crates, ladders, stones, walls. Plain arrays, no Blender."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..shapes.branch import Branch, to_unit
from ..shapes.ground import Ground
from ..shapes.meshes import Mesh, grid_quads, join_meshes, make_tube
from ..species import linear_rgb

FloatArray = NDArray[np.float64]

WORDS = ("bucket", "crate", "ladder", "stone", "wall")
"""The kinds of objects, which take turns."""
_PAINTS = ("#c62a22", "#e8b61c", "#2a5fb4", "#3f8a3a", "#e7e4dc", "#2b2c2e", "#e06a1c", "#7d8288", "#d9569b")
_WOODS = ("#b08d5c", "#8f7350", "#a79a86")
_STONES = ("#8d8980", "#a39a8a", "#6f6d69", "#b5ad9c")
_WALLS = ("#c9c1b0", "#a9523a", "#d8d5cc", "#8c8a84", "#b98a5e")


@dataclass(frozen=True, kw_only=True)
class SceneObject:
    """One object in the world: its word, its surface in metres, and the share of light that it mirrors."""

    word: str
    mesh: Mesh
    gloss: float = 0.0


def place_objects(
    rng: np.random.Generator, branches: Sequence[Branch], ground: Ground, size: float, count: int, x0: float
) -> list[SceneObject]:
    """This many objects around the trunk at x = x0 of a tree of height 2.3 m times `size`, kind after kind."""
    makers: dict[str, Callable[[], Mesh]] = {
        "bucket": lambda: _make_bucket(rng, branches),
        "crate": lambda: _make_crates(rng, ground, size, x0),
        "ladder": lambda: _make_ladder(rng, ground, size, x0),
        "stone": lambda: _make_stones(rng, ground, size, x0),
        "wall": lambda: _make_wall(rng, size, x0),
    }
    first = int(rng.integers(len(WORDS)))
    words = [WORDS[(first + i) % len(WORDS)] for i in range(count)]
    return [SceneObject(word=word, mesh=makers[word]()) for word in words]


def _make_bucket(rng: np.random.Generator, branches: Sequence[Branch]) -> Mesh:
    """Make a picking bucket that hangs on a branch by its handle."""
    limbs = [b for b in branches if b.generation in (1, 2) and b.points[-1][2] > 0.5]
    hook, _ = limbs[int(rng.integers(len(limbs)))].at(float(rng.uniform(0.3, 0.8)))
    high, wide = rng.uniform(0.2, 0.3), rng.uniform(0.1, 0.15)
    profile = np.array([[0.0, 0.8 * wide], [high, wide], [high, 0.94 * wide], [0.02, 0.76 * wide], [0.02, 0.0]])
    turns = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    vertices = np.concatenate([np.hstack([r * ring, np.full((24, 1), z)]) for z, r in profile])
    body = Mesh(vertices=vertices, quads=grid_quads(len(profile), 24, wrap=True))
    arc = np.linspace(0, np.pi, 9)
    handle = make_tube(
        np.stack([wide * np.cos(arc), np.zeros(9), high + 1.1 * wide * np.sin(arc)], axis=1),
        np.full(9, 0.003),
        segments=5,
    )
    foot = hook - [0, 0, high + 1.1 * wide]
    return _place(join_meshes([_paint(rng, body, _PAINTS), _paint(rng, handle, ("#6d6f72",))]), rng, foot)


def _make_crates(rng: np.random.Generator, ground: Ground, size: float, x0: float) -> Mesh:
    """Make one to four open crates of slats on each other."""
    long, wide, high = rng.uniform(0.45, 0.6), rng.uniform(0.3, 0.4), rng.uniform(0.22, 0.32)
    wooden = bool(rng.uniform() < 0.5)
    colors = (_WOODS if wooden else _PAINTS)[int(rng.integers(3 if wooden else len(_PAINTS)))]
    slats = 3 if wooden else 5
    parts = [_make_box([0, 0, 0.01], [long, wide, 0.02])]
    for level in range(slats):
        z, thick = high * (level + 0.5) / slats, 0.36 * high / slats
        parts += [_make_box([0, s * wide / 2, z], [long, 0.015, 2 * thick]) for s in (-1, 1)]
        parts += [_make_box([s * long / 2, 0, z], [0.015, wide, 2 * thick]) for s in (-1, 1)]
    parts += [_make_box([s * long / 2, t * wide / 2, high / 2], [0.03, 0.03, high]) for s in (-1, 1) for t in (-1, 1)]
    crate = join_meshes([_paint(rng, part, (colors,), 0.1) for part in parts])
    stack = [_place(crate, rng, np.array([*rng.normal(0, 0.01, 2), k * high]), 0.03) for k in range(rng.integers(1, 5))]
    return _place(join_meshes(stack), rng, choose_spot(rng, ground, size, x0, 0.35, 1.0))


def _make_ladder(rng: np.random.Generator, ground: Ground, size: float, x0: float) -> Mesh:
    """Make a ladder that leans into the crown."""
    foot = choose_spot(rng, ground, size, x0, 0.7, 1.0)
    head = np.array([x0, 0, 0]) + [*0.15 * (foot[:2] - [x0, 0]), size * rng.uniform(1.3, 2.0)]
    side = 0.2 * to_unit(np.cross(head - foot, [0.0, 0.0, 1.0]))
    thick = rng.uniform(0.015, 0.025)
    rails = [
        make_tube(np.linspace(foot + s * side, head + s * side, 3), np.full(3, thick), segments=6) for s in (-1, 1)
    ]
    steps = [
        make_tube(np.stack([foot + f * (head - foot) + s * side for s in (-1, 1)]), np.full(2, 0.7 * thick), segments=6)
        for f in np.arange(0.1, 1.0, 0.28 / float(np.linalg.norm(head - foot)))
    ]
    return _paint(rng, join_meshes([*rails, *steps]), (*_WOODS, "#b9bdc2"))


def _make_stones(rng: np.random.Generator, ground: Ground, size: float, x0: float) -> Mesh:
    """Make a few round stones of 10 to 40 cm together."""
    middle = choose_spot(rng, ground, size, x0, 0.3, 1.1)
    turns, rises = np.linspace(0, 2 * np.pi, 20, endpoint=False), np.linspace(-np.pi / 2, np.pi / 2, 11)
    ball = np.stack([np.outer(np.cos(rises), f(turns)) for f in (np.cos, np.sin)], axis=2)
    ball = np.concatenate([ball, np.broadcast_to(np.sin(rises)[:, None, None], (11, 20, 1))], axis=2).reshape(-1, 3)
    stones = []
    for _ in range(rng.integers(2, 7)):
        waves = sum(0.09 * np.sin(ball @ rng.normal(0, 2.2, 3) + rng.uniform(0, 6.28)) for _ in range(4))
        half = rng.uniform(0.05, 0.2) * np.array([1, rng.uniform(0.6, 1), rng.uniform(0.4, 0.8)])
        place = middle + [*rng.normal(0.0, 0.3, 2), 0.4 * half[2]]
        stone = Mesh(vertices=ball * (1 + waves)[:, None] * half, quads=grid_quads(11, 20, wrap=True))
        stones.append(_place(_paint(rng, stone, _STONES, 0.15), rng, place))
    return join_meshes(stones)


def _make_wall(rng: np.random.Generator, size: float, x0: float) -> Mesh:
    """Make a wall of plastered stone or brick behind the tree, with courses of slightly different colour."""
    away, turn = size * rng.uniform(2.2, 4.5), rng.uniform(0, 2 * np.pi)
    long, high = size * rng.uniform(2.0, 6.0), size * rng.uniform(0.6, 2.5)
    course = rng.uniform(0.08, 0.35)
    x, z = np.arange(-long / 2, long / 2, 2.2 * course), np.arange(0.0, high, course)
    block = _make_box([0, 0, course / 2], [2.15 * course, 0.2, 0.96 * course])
    color = _WALLS[int(rng.integers(len(_WALLS)))]
    back = _paint(rng, _make_box([0, 0.03, high / 2], [long + 2 * course, 0.2, high]), ("#b0aa9c",))
    blocks = [
        _paint(rng, Mesh(vertices=block.vertices + [a + (k % 2) * 1.1 * course, 0, b], quads=block.quads), (color,))
        for k, b in enumerate(z)
        for a in x
    ]
    wall = join_meshes([back, *blocks])
    c, s = np.cos(turn), np.sin(turn)
    frame = np.array([[-s, c, 0], [c, s, 0], [0, 0, 1]])  # its long side faces the trunk
    return Mesh(
        vertices=wall.vertices @ frame.T + [x0 + away * c, away * s, -0.05], quads=wall.quads, colors=wall.colors
    )


def choose_spot(
    rng: np.random.Generator, ground: Ground, size: float, x0: float, nearest: float, farthest: float
) -> FloatArray:
    """Choose a place on the ground around x = x0, between these distances in metres times `size`."""
    turn, away = rng.uniform(0, 2 * np.pi), size * rng.uniform(nearest, farthest)
    x, y = x0 + away * np.cos(turn), away * np.sin(turn)
    return np.array([x, y, float(ground.relief(x, y))])


def _make_box(middle: Sequence[float], sides: Sequence[float]) -> Mesh:
    corners = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
    faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    return Mesh(vertices=corners * sides + middle, quads=np.array(faces))


def _paint(rng: np.random.Generator, mesh: Mesh, colors: Sequence[str], spread: float = 0.06) -> Mesh:
    """Paint the mesh in one of these colours, slightly lighter or darker, with variation."""
    color = linear_rgb(colors[int(rng.integers(len(colors)))]) * np.exp(rng.normal(0.0, spread))
    mottled = color * np.exp(rng.normal(0.0, 0.05, (len(mesh.vertices), 1)))
    return Mesh(vertices=mesh.vertices, quads=mesh.quads, colors=np.clip(mottled, 0, 1))


def _place(mesh: Mesh, rng: np.random.Generator, foot: FloatArray, turn: float = np.pi) -> Mesh:
    """Place the mesh at `foot`, rotated about the vertical by at most `turn`."""
    angle = rng.uniform(-turn, turn)
    c, s = np.cos(angle), np.sin(angle)
    frame = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return Mesh(vertices=mesh.vertices @ frame.T + foot, quads=mesh.quads, colors=mesh.colors)
