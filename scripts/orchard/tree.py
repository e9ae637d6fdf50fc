"""The tree's skeleton and where its leaves sit. World frame: z up, the trunk's foot at the origin, metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .species import Species

FloatArray = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, kw_only=True)
class Branch:
    """A curved, tapering piece of wood; generation 0 is the trunk, 1 a limb, 2 a branch, 3 a twig."""

    points: FloatArray
    """(K, 3) centre line from the base to the tip."""
    radii: FloatArray
    """(K,) half thickness."""
    generation: int

    def at(self, fraction: float) -> tuple[FloatArray, FloatArray]:
        """Position and unit direction at a fraction of the length."""
        place = fraction * (len(self.points) - 1)
        i = min(int(place), len(self.points) - 2)
        step = self.points[i + 1] - self.points[i]
        return self.points[i] + (place - i) * step, step / np.linalg.norm(step)

    def radius_at(self, fraction: float) -> float:
        """Half thickness at a fraction of the length."""
        return float(np.interp(fraction * (len(self.radii) - 1), np.arange(len(self.radii)), self.radii))


@dataclass(frozen=True, kw_only=True)
class Leaves:
    """Placed leaves: N rows each."""

    bases: FloatArray
    """(N, 3) where the leaf's stalk meets the wood."""
    frames: FloatArray
    """(N, 3, 3) columns: across the leaf, along its midrib, its upper side's normal."""
    lengths: FloatArray
    """(N,) midrib lengths in metres."""
    shades: FloatArray
    """(N,) from the darkest colour, 0, to the lightest, 1."""


def unit(v: FloatArray) -> FloatArray:
    """The vector, or each row, at length 1."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12)


def _path(
    rng: np.random.Generator,
    start: FloatArray,
    direction: FloatArray,
    length: float,
    *,
    steps: int,
    wander: float,
    lift: float,
    droop: float,
) -> FloatArray:
    """(steps + 1, 3) a line that first strives upward (lift) and bends down towards its loaded end (droop)."""
    points = [start]
    d = unit(direction)
    drift = rng.normal(0.0, wander, 3)
    for i in range(steps):
        s = (i + 0.5) / steps
        drift = 0.6 * drift + rng.normal(0.0, wander, 3)
        d = unit(d + drift + UP * (lift * (1 - s) - droop * s) / steps)
        points.append(points[-1] + d * length / steps)
    return np.array(points)


def _taper(base: float, tip: float, count: int) -> FloatArray:
    return tip + (base - tip) * (1.0 - np.linspace(0.0, 1.0, count)) ** 0.8


def _sideways(rng: np.random.Generator, along: FloatArray, turn: float, angle: float) -> FloatArray:
    """A direction at an angle from `along`, turned around it."""
    a = unit(np.cross(along, UP + rng.normal(0.0, 0.05, 3)))
    b = np.cross(a, along)
    return np.cos(angle) * along + np.sin(angle) * (np.cos(turn) * a + np.sin(turn) * b)


def grow(rng: np.random.Generator, species: Species) -> tuple[Branch, ...]:
    """Trunk, limbs around it by the golden angle, branches on the limbs and twigs on the branches."""
    size = species.tree_height / 2.3
    trunk = _trunk(rng, size)
    branches = [trunk]
    count = int(rng.integers(10, 13))
    azimuth = rng.uniform(0, 2 * np.pi)
    for i in range(count):
        f = 0.30 + 0.66 * (i + rng.uniform(-0.25, 0.25)) / (count - 1)
        f = float(np.clip(f, 0.27, 0.97))
        azimuth += 2.39996 + rng.normal(0.0, 0.25)
        base, _ = trunk.at(f)
        rise = np.radians(rng.uniform(18, 38) + 30 * max(0.0, f - 0.45))
        direction = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
        length = size * (1.10 - 0.55 * f) * rng.uniform(0.9, 1.1)
        limb = Branch(
            points=_path(rng, base, direction, length, steps=14, wander=0.055, lift=0.5, droop=1.1),
            radii=_taper(min(0.62 * trunk.radius_at(f), 0.021 * size), 0.0045 * size**0.5, 15),
            generation=1,
        )
        branches += [limb, *_side_shoots(rng, limb, size)]
    branches += _side_shoots(rng, trunk, size, first=0.72)
    return tuple(branches)


def _trunk(rng: np.random.Generator, size: float) -> Branch:
    lean = np.array([*rng.normal(0.0, 0.05, 2), 1.0])
    points = _path(rng, np.array([0.0, 0.0, -0.04]), lean, 1.78 * size, steps=24, wander=0.035, lift=2.2, droop=-2.0)
    radii = _taper(0.047 * size, 0.007 * size, 25)
    flare = 1.0 + 0.5 * np.exp(-np.arange(25) / 1.2)
    return Branch(points=points, radii=radii * flare, generation=0)


def _side_shoots(rng: np.random.Generator, limb: Branch, size: float, first: float = 0.2) -> list[Branch]:
    """Branches on a limb, alternating sides, each with twigs, and twigs on the limb itself."""
    shoots: list[Branch] = []
    span = float(np.linalg.norm(np.diff(limb.points, axis=0), axis=1).sum())
    number = int(np.clip(round(span * (1 - first) / (0.105 * size)), 2, 8))
    turn = rng.uniform(0, 2 * np.pi)
    for j in range(number):
        f = first + (1 - first) * (j + rng.uniform(0.2, 0.8)) / number
        base, along = limb.at(f)
        turn += np.pi + rng.normal(0.0, 0.6)
        direction = _sideways(rng, along, turn, np.radians(rng.uniform(38, 65))) + UP * 0.15
        length = size * rng.uniform(0.26, 0.44) * (1.1 - 0.45 * f)
        branch = Branch(
            points=_path(rng, base, direction, length, steps=8, wander=0.09, lift=0.5, droop=1.0),
            radii=_taper(min(0.6 * limb.radius_at(f), 0.0075 * size**0.5), 0.0024 * size**0.5, 9),
            generation=2,
        )
        shoots += [branch, *_twigs(rng, branch, size, number=int(rng.integers(3, 6)), length=0.17)]
    shoots += _twigs(rng, limb, size, number=5, length=0.14, first=first)
    return shoots


def _twigs(
    rng: np.random.Generator, parent: Branch, size: float, *, number: int, length: float, first: float = 0.15
) -> list[Branch]:
    twigs = []
    turn = rng.uniform(0, 2 * np.pi)
    for k in range(number):
        f = first + (1 - first) * (k + rng.uniform(0.1, 0.9)) / number
        base, along = parent.at(min(f, 0.99))
        turn += 2.4 + rng.normal(0.0, 0.5)
        direction = _sideways(rng, along, turn, np.radians(rng.uniform(35, 70))) + UP * 0.2
        reach = size * length * rng.uniform(0.6, 1.3)
        twigs.append(
            Branch(
                points=_path(rng, base, direction, reach, steps=5, wander=0.1, lift=0.4, droop=0.6),
                radii=_taper(min(0.7 * parent.radius_at(f), 0.0030 * size**0.5), 0.0014 * size**0.5, 6),
                generation=3,
            )
        )
    return twigs


def wood_samples(branches: tuple[Branch, ...], spacing: float = 0.012) -> FloatArray:
    """(M, 4) points along every centre line with the radius there."""
    rows = []
    for branch in branches:
        length = float(np.linalg.norm(np.diff(branch.points, axis=0), axis=1).sum())
        k = np.linspace(0.0, len(branch.points) - 1.0, max(2, int(length / spacing)))
        knots = np.arange(len(branch.points))
        rows.append(np.stack([np.interp(k, knots, c) for c in (*branch.points.T, branch.radii)], axis=1))
    return np.vstack(rows)


def place_leaves(rng: np.random.Generator, branches: tuple[Branch, ...], species: Species, count: int) -> Leaves:
    """Leaves along twigs and the outer parts of branches, facing the light, hanging a little."""
    hosts = [b for b in branches if b.generation >= 2]
    spans = np.array([np.linalg.norm(np.diff(b.points, axis=0), axis=1).sum() for b in hosts])
    spans *= np.array([1.0 if b.generation == 3 else 0.6 for b in hosts])
    choice = rng.choice(len(hosts), size=count, p=spans / spans.sum())
    fractions = rng.beta(1.6, 1.0, size=count)
    bases = np.empty((count, 3))
    alongs = np.empty((count, 3))
    for n, (host, f) in enumerate(zip(choice, fractions, strict=True)):
        bases[n], alongs[n] = hosts[host].at(float(f))
    outward = unit(bases * [1, 1, 0] + [0, 0, 0.02])
    random = unit(rng.normal(size=(count, 3)))
    side = unit(random - (random * alongs).sum(axis=1, keepdims=True) * alongs)
    midribs = unit(0.55 * alongs + 0.85 * side + 0.35 * outward + [0, 0, -0.25])
    normals = UP + 0.35 * outward + rng.normal(0.0, 0.42, (count, 3))
    normals = unit(normals - (normals * midribs).sum(axis=1, keepdims=True) * midribs)
    across = np.cross(midribs, normals)
    return Leaves(
        bases=bases,
        frames=np.stack([across, midribs, normals], axis=2),
        lengths=species.leaf_length * np.clip(rng.normal(1.0, 0.16, count), 0.55, 1.35),
        shades=np.clip(rng.beta(2.0, 2.2, count) + 0.25 * (fractions - 0.6), 0.0, 1.0),
    )
