"""The ground: gentle relief, patches of soil in grass, tufts and posts. Plain arrays, no Blender."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..species import linear_rgb
from .meshes import Mesh, make_tube

FloatArray = NDArray[np.float64]


class HeightField:
    """Gentle relief and patches of the ground: sums of plane waves, the same everywhere for one seed."""

    def __init__(self, rng: np.random.Generator, *, amplitude: float, wavelength: tuple[float, float]) -> None:
        count = 14
        turn = rng.uniform(0, 2 * np.pi, count)
        wave = 2 * np.pi / rng.uniform(*wavelength, count)
        self.vectors = np.stack([np.cos(turn) * wave, np.sin(turn) * wave])
        self.phases = rng.uniform(0, 2 * np.pi, count)
        self.amplitude = amplitude * np.sqrt(2.0 / count)

    def __call__(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        phase = np.multiply.outer(np.asarray(x), self.vectors[0]) + np.multiply.outer(np.asarray(y), self.vectors[1])
        return self.amplitude * np.sin(phase + self.phases).sum(axis=-1)


@dataclass(frozen=True, kw_only=True)
class Tuft:
    """A clump of grass."""

    position: FloatArray
    turn: float
    scale: float
    shade: float
    prototype: int


@dataclass(frozen=True, kw_only=True)
class Ground:
    """Everything below the tree and around it."""

    relief: HeightField
    patches: HeightField
    """Above `soil_level` it is soil, below it grass."""
    soil_level: float
    tufts: tuple[Tuft, ...]
    posts: tuple[Mesh, ...]
    grass: tuple[FloatArray, FloatArray]
    """Darkest and lightest grass, linear RGB."""
    soil: tuple[FloatArray, FloatArray]
    half_row: float
    """Half the distance from the first trunk of the row to the last; the soil is bare along it."""

    def soil_share(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Share of soil at a position, from 0 to 1; it is also bare under the row, and hardly visible from afar."""
        away = np.hypot(np.maximum(np.abs(x) - self.half_row, 0.0), y)
        bare = 0.9 * np.exp(-((away / 0.55) ** 2))
        near = np.clip((6.0 - away) / 3.5, 0.15, 1.0)
        return near * np.clip((self.patches(x, y) + bare - self.soil_level) / 0.35 + 0.5, 0.0, 1.0)


GRASSES = (("#4c6426", "#84964a"), ("#4f6f2a", "#86a04c"), ("#66702f", "#9d9c54"), ("#3f6126", "#7aa043"))
SOILS = (("#5a4632", "#86694c"), ("#4b3b2c", "#75604a"), ("#6d5a44", "#9a8263"))
TUFT_PROTOTYPES = 5


def lay_ground(rng: np.random.Generator, *, size: float, half_row: float = 0.0, posts: int = -1) -> Ground:
    """Ground for trees of the given size (1: a tree of 2.3 m) in a row of the given half length.

    `posts`: number of stakes and posts; below 0: random, from none to two.
    """
    relief = HeightField(rng, amplitude=0.012 * size, wavelength=(0.6 * size, 2.5 * size))
    patches = HeightField(rng, amplitude=0.5, wavelength=(0.7 * size, 3.5 * size))
    soil_level = float(rng.uniform(0.1, 0.9))
    grass = GRASSES[rng.integers(len(GRASSES))]
    soil = SOILS[rng.integers(len(SOILS))]
    ground = Ground(
        relief=relief,
        patches=patches,
        soil_level=soil_level,
        tufts=(),
        posts=_place_posts(rng.spawn(1)[0], size, half_row, posts),
        grass=(linear_rgb(grass[0]), linear_rgb(grass[1])),
        soil=(linear_rgb(soil[0]), linear_rgb(soil[1])),
        half_row=half_row,
    )
    return replace(ground, tufts=_place_tufts(rng, ground, size))


def _place_tufts(rng: np.random.Generator, ground: Ground, size: float) -> tuple[Tuft, ...]:
    tufts = []
    longer = 1.0 + ground.half_row / (1.6 * size)
    for _ in range(int(rng.integers(300, 600) * longer)):
        away, turn = size * 3.2 * np.sqrt(rng.uniform(0.01, 1.0)), rng.uniform(0, 2 * np.pi)
        x, y = float(away * np.cos(turn)), float(away * np.sin(turn))
        x += rng.uniform(-1.0, 1.0) * ground.half_row
        scale, shade, spin = rng.uniform(0.6, 1.3), rng.uniform(), rng.uniform(0, 2 * np.pi)
        prototype = int(rng.integers(TUFT_PROTOTYPES))
        if float(ground.soil_share(np.array(x), np.array(y))) > rng.uniform(0.3, 0.9):
            continue
        position = np.array([x, y, float(ground.relief(x, y)) - 0.005])
        tufts.append(Tuft(position=position, turn=spin, scale=scale * size**0.5, shade=shade, prototype=prototype))
    return tuple(tufts)


def _place_posts(rng: np.random.Generator, size: float, half_row: float, number: int) -> tuple[Mesh, ...]:
    """Place stakes near the trunks and fence posts farther out, alternating; with a random number, each with its
    probability."""
    wanted = [bool(rng.uniform() < 0.6) for _ in range(2)] if number < 0 else [True] * number
    posts = []
    for i, stands in enumerate(wanted):
        stake, turn = i % 2 == 0, rng.uniform(0, 2 * np.pi)
        away = (rng.uniform(0.16, 0.3) if stake else rng.uniform(1.25, 1.6)) * size
        height = (rng.uniform(0.9, 1.5) if stake else rng.uniform(0.8, 1.3)) * size
        radius = rng.uniform(0.016, 0.026) if stake else rng.uniform(0.03, 0.045)
        foot = np.array([away * np.cos(turn) + rng.uniform(-1.0, 1.0) * half_row, away * np.sin(turn), -0.05])
        head = foot + np.array([*rng.normal(0.0, 0.015, 2), 1.0]) * height
        if stands:
            posts.append(make_tube(np.linspace(foot, head, 4), np.full(4, radius), segments=12, cap=True))
    return tuple(posts)
