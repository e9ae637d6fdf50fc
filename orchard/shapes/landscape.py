"""Meshes of the ground and of the far hedge. Plain arrays, no Blender."""

from __future__ import annotations

import numpy as np

from ..species import linear_rgb
from .ground import Ground
from .meshes import Mesh, grid_quads

UPWARD = [0, 3, 2, 1]
"""Order of a quad's corners in which rings that grow outward face up."""


def make_ground_mesh(ground: Ground, size: float) -> Mesh:
    """Make a disc whose rings grow outward, coloured by its patches."""
    radii = np.concatenate([np.linspace(0.0, 4.0, 110)[1:], np.geomspace(4.15, 80.0, 36)]) * size
    turns = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    x, y = (np.outer(radii, f(turns)).ravel() for f in (np.cos, np.sin))
    x, y = np.append(x, 0.0), np.append(y, 0.0)
    fade = np.clip(1.5 - np.hypot(x, y) / (8 * size), 0, 1)
    soil = ground.soil_share(x, y)[:, None]
    tone = np.clip(0.5 + 0.5 * ground.patches(1.7 * x + 5, 1.7 * y - 3), 0, 1)[:, None]
    grass = ground.grass[0] + (ground.grass[1] - ground.grass[0]) * tone
    earth = ground.soil[0] + (ground.soil[1] - ground.soil[0]) * tone
    rings, columns = len(radii), len(turns)
    quads = grid_quads(rings, columns, wrap=True)[:, UPWARD]
    middle, first = np.full(columns, rings * columns), np.arange(columns)
    fan = np.stack([first, np.roll(first, -1), middle, middle], axis=1)
    return Mesh(
        vertices=np.stack([x, y, ground.relief(x, y) * fade], axis=1),
        quads=np.vstack([quads, fan]),
        colors=grass * (1 - soil) + earth * soil,
    )


def make_backdrop_mesh(rng: np.random.Generator, size: float) -> Mesh:
    """Make a far hedge around the place, uneven in height and colour, hazy."""
    turns = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    away = rng.uniform(18, 40) * size
    shape = sum(np.sin(m * turns + rng.uniform(0, 6.28)) / m**0.6 for m in (2, 3, 5, 9, 14, 23, 37))
    high = away * rng.uniform(0.11, 0.22) * np.clip(1.0 + 0.25 * shape, 0.5, 2.2)
    levels = np.array([-0.05, 0.0, 0.4, 0.75, 1.0])
    z = levels[:, None] * high
    r = away * (1 + 0.03 * levels[:, None] + 0.015 * shape)
    vertices = np.stack([r * np.cos(turns), r * np.sin(turns), z], axis=2).reshape(-1, 3)
    dark, light = linear_rgb("#3c4f29"), linear_rgb("#7c8d5c")
    tone = np.clip(0.25 + 0.5 * levels[:, None] + 0.2 * rng.normal(size=(5, 240)), 0, 1).reshape(-1, 1)
    rows, columns = z.shape
    quads = grid_quads(rows, columns, wrap=True)[:, UPWARD]
    return Mesh(vertices=vertices, quads=quads, colors=dark + (light - dark) * tone)
