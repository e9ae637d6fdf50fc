"""Triangle and quad meshes of wood, leaves, fruit and grass as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..species import Species, Variant, linear_rgb
from .body import Body, frame_of
from .branch import to_unit

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Vertices (V, 3) in metres, quads (F, 4) of vertex numbers (a triangle repeats its last), linear RGB (V, 3)."""

    vertices: FloatArray
    quads: IntArray
    colors: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def triangles(self) -> IntArray:
        """(T, 3) triangles of all quads, without the degenerate ones."""
        q = self.quads
        both = np.vstack([q[:, [0, 1, 2]], q[:, [0, 2, 3]]])
        return both[(both[:, 0] != both[:, 1]) & (both[:, 1] != both[:, 2]) & (both[:, 0] != both[:, 2])]


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """Join several meshes."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return Mesh(
        vertices=np.vstack([m.vertices for m in meshes]),
        quads=np.vstack([m.quads + s for m, s in zip(meshes, starts, strict=True)]),
        colors=np.vstack([m.colors for m in meshes]),
    )


def grid_quads(rows: int, columns: int, *, wrap: bool) -> IntArray:
    """Quads between neighbouring rows of a grid of vertices numbered row by row."""
    r = np.arange(rows - 1)[:, None] * columns
    c = np.arange(columns if wrap else columns - 1)[None, :]
    n = (c + 1) % columns
    return np.stack([r + c, r + n, r + columns + n, r + columns + c], axis=2).reshape(-1, 4)


def make_tube(points: FloatArray, radii: FloatArray, *, segments: int, cap: bool = False) -> Mesh:
    """Make a tapering tube around a centre line, its rings turned as little as possible from one to the next."""
    steps = to_unit(np.gradient(points, axis=0))
    side = to_unit(np.cross(steps[0], [0.31, 0.95, 0.07]))
    angles = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)
    rings = []
    for point, step, radius in zip(points, steps, radii, strict=True):
        side = to_unit(side - (side @ step) * step)
        rings.append(point + radius * (np.outer(np.cos(angles), side) + np.outer(np.sin(angles), np.cross(step, side))))
    quads = grid_quads(len(points), segments, wrap=True)
    vertices = np.vstack(rings)
    if cap:
        tip = len(vertices)
        vertices = np.vstack([vertices, points[-1:] + steps[-1] * radii[-1] * 0.3])
        last = np.arange(segments) + (len(points) - 1) * segments
        fan = np.stack([last, np.roll(last, -1), np.full(segments, tip), np.full(segments, tip)], axis=1)
        quads = np.vstack([quads, fan])
    return Mesh(vertices=vertices, quads=quads)


def make_leaf_prototype(rng: np.random.Generator, species: Species) -> Mesh:
    """Make a leaf of midrib length 1 along +y from the origin, folded along its midrib, curved down, on a short
    stalk."""
    rows = 8
    t = np.linspace(0.0, 1.0, rows)
    tip = species.leaf_tip
    warped = np.where(t < tip, 0.5 * t / tip, 0.5 + 0.5 * (t - tip) / (1 - tip))
    half = 0.5 * rng.uniform(0.85, 1.12) * species.leaf_width / species.leaf_length * np.sin(np.pi * warped) ** 0.75
    half[0] = half[-1] = 0.006
    fold = np.radians(rng.uniform(8, 38))
    bend = rng.uniform(0.3, 1.5)
    stalk = 0.22
    # The midrib bends downward along an arc of `bend` radians.
    angle = bend * t
    y = stalk + np.concatenate([[0.0], np.cumsum(np.cos(angle[:-1]))]) / (rows - 1)
    z = -np.concatenate([[0.0], np.cumsum(np.sin(angle[:-1]))]) / (rows - 1) + 0.04
    ripple = rng.uniform(0.015, 0.045) * np.sin(2 * np.pi * (rng.uniform(1.0, 2.6) * t + rng.uniform()))
    twist = rng.uniform(-0.45, 0.45) * t
    across = np.array([-1.0, -0.55, 0.0, 0.55, 1.0])
    u = across[None, :] * half[:, None]
    lift = np.abs(u) * np.tan(fold) + ripple[:, None] * (np.abs(across)[None, :] == 1.0) + u * twist[:, None]
    blade = np.stack([u * np.cos(fold), np.broadcast_to(y[:, None], u.shape), z[:, None] + lift], axis=2)
    stem = np.array([[-0.012, 0, 0], [0.012, 0, 0], [0.012, stalk, 0.04], [-0.012, stalk, 0.04]])
    return Mesh(
        vertices=np.vstack([blade.reshape(-1, 3), stem]),
        quads=np.vstack([grid_quads(rows, 5, wrap=False), np.arange(4)[None] + rows * 5]),
    )


def make_tuft_prototype(rng: np.random.Generator) -> Mesh:
    """Make a clump of some twenty bent grass blades, about 10 cm high."""
    blades = []
    for _ in range(int(rng.integers(16, 26))):
        turn, lean, high = rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.8), rng.uniform(0.05, 0.12)
        foot = np.array([*rng.normal(0.0, 0.025, 2), 0.0])
        out = np.array([np.cos(turn), np.sin(turn), 0.0])
        side = np.array([-out[1], out[0], 0.0]) * rng.uniform(0.003, 0.006)
        s = np.array([0.0, 0.5, 1.0])[:, None]
        line = foot + high * (s * [0, 0, 1] + lean * s**2 * out) - high * 0.35 * lean * s**2 * [0, 0, 1]
        width = np.array([1.0, 0.75, 0.1])[:, None]
        vertices = np.stack([line - side * width, line + side * width], axis=1).reshape(-1, 3)
        blades.append(Mesh(vertices=vertices, quads=np.array([[0, 1, 3, 2], [2, 3, 5, 4]])))
    return join_meshes(blades)


def make_fruit_mesh(rng: np.random.Generator, body: Body, variant: Variant, *, segments: int = 26) -> Mesh:
    """Make the body's surface in the world frame with the colours of its variety."""
    profile, k = body.profile, len(body.profile)
    angles = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)
    z = np.repeat(profile[1:-1, 0], segments)
    r = np.repeat(profile[1:-1, 1], segments)
    turn = np.tile(angles, k - 2)
    local = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    local = np.vstack([local, [[0, 0, profile[0, 0]], [0, 0, profile[-1, 0]]]])
    top, bottom, last = len(local) - 2, len(local) - 1, (k - 3) * segments
    ring = np.arange(segments)
    after = np.roll(ring, -1)
    caps = [
        np.stack([ring, after, np.full(segments, top), np.full(segments, top)], axis=1),
        np.stack([last + after, last + ring, np.full(segments, bottom), np.full(segments, bottom)], axis=1),
    ]
    quads = np.vstack([grid_quads(k - 2, segments, wrap=True)[:, ::-1], *caps])
    return Mesh(
        vertices=body.center + local @ frame_of(body.axis).T, quads=quads, colors=_paint_skin(rng, local, body, variant)
    )


def _paint_skin(rng: np.random.Generator, local: FloatArray, body: Body, variant: Variant) -> FloatArray:
    """Return colours (V, 3): gradient along the axis, a blush on one side, stripes and gentle mottling."""
    heights = body.profile[:, 0]
    s = (heights.max() - local[:, 2]) / (heights.max() - heights.min())
    knots = np.array([linear_rgb(c) for c in (variant.top, variant.middle, variant.bottom)])
    colors = np.stack([np.interp(s, [0.05, 0.5, 0.95], knots[:, c]) for c in range(3)], axis=1)
    turn = np.arctan2(local[:, 1], local[:, 0])
    toward = to_unit(rng.normal(size=3) * [1, 1, 0.4])
    facing = to_unit(local) @ toward
    low, high = variant.blush_strength
    strength = rng.uniform(low, high)
    edge = np.cos(np.pi * min(variant.blush_width, 0.98)) + rng.normal(0.0, 0.15)
    ragged = 0.25 * sum(np.sin(m * turn + rng.uniform(0, 6.28) + 2 * s) / m for m in (2, 3, 5))
    blush = strength * np.clip((facing - edge + 0.35 * ragged) / 0.7, 0.0, 1.0)
    stripes = variant.stripes * (0.5 + 0.5 * np.sin(11 * turn + 1.5 * np.sin(3 * turn + rng.uniform(0, 6.28))))
    share = np.clip(blush * (1.0 - 0.6 * stripes), 0.0, 1.0)[:, None]
    colors = colors * (1 - share) + linear_rgb(variant.blush) * share
    hollow = np.exp(-((np.hypot(local[:, 0], local[:, 1]) / (0.10 * np.ptp(heights))) ** 2))[:, None]
    colors = colors * (1 - 0.45 * hollow) + linear_rgb("#6b5a2c") * 0.45 * hollow
    return np.clip(colors * rng.uniform(0.88, 1.12) * (1 + rng.normal(0.0, 0.03, 3)), 0.0, 1.0)


def make_stalk_mesh(body: Body, anchor: FloatArray, diameter: float) -> Mesh:
    """Make a thin bent stalk from just inside the fruit to the wood."""
    start = body.top - body.axis * 0.01 * diameter
    t = np.linspace(0.0, 1.0, 5)[:, None]
    control = start + body.axis * 0.5 * np.linalg.norm(anchor - start)
    line = (1 - t) ** 2 * start + 2 * t * (1 - t) * control + t**2 * anchor
    return make_tube(line, np.full(5, 0.0012 + 0.008 * diameter), segments=5)
