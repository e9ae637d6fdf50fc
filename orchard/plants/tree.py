"""The tree's skeleton in each of its forms. World frame: z up, the trunk's foot at the origin, metres.

A tree's size is its height over 2.3 m, whatever its form; its row runs along x.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..shapes.branch import Branch
from ..species import Species
from .shoots import path, side_shoots, taper

FloatArray = NDArray[np.float64]


def grow(rng: np.random.Generator, species: Species, form: str = "spindle") -> tuple[Branch, ...]:
    """The wood of one tree; the first branch is its trunk."""
    size = species.tree_height / 2.3
    grown = {"spindle": _spindle, "wall": _wall, "vase": _vase, "bush": _grow_bush}[form](rng, size)
    return tuple(grown)


def _trunk(rng: np.random.Generator, size: float, height: float = 1.78, thickness: float = 0.047) -> Branch:
    """A nearly straight trunk from just below the ground."""
    lean = np.array([*rng.normal(0.0, 0.05, 2), 1.0])
    foot = np.array([0.0, 0.0, -0.04])
    points = path(rng, foot, lean, height * size, steps=24, wander=0.035, lift=2.2, droop=-2.0)
    radii = taper(thickness * size, 0.007 * size, 25)
    flare = 1.0 + 0.5 * np.exp(-np.arange(25) / 1.2)
    return Branch(points=points, radii=radii * flare, generation=0)


def _limb(
    rng: np.random.Generator,
    trunk: Branch,
    fraction: float,
    azimuth: float,
    rise: float,
    length: float,
    *,
    size: float,
    droop: float = 1.1,
    thickest: float = 0.021,
) -> list[Branch]:
    """A limb with its branches and twigs; azimuth and rise in radians, length in metres."""
    base, _ = trunk.at(fraction)
    direction = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
    limb = Branch(
        points=path(rng, base, direction, length, steps=14, wander=0.055, lift=0.5, droop=droop),
        radii=taper(min(0.62 * trunk.radius_at(fraction), thickest * size), 0.0045 * size**0.5, 15),
        generation=1,
    )
    return [limb, *side_shoots(rng, limb, size)]


def _spindle(rng: np.random.Generator, size: float) -> list[Branch]:
    """A leader with limbs around it by the golden angle, the lower ones longer."""
    trunk = _trunk(rng, size)
    branches = [trunk]
    count = int(rng.integers(10, 13))
    azimuth = rng.uniform(0, 2 * np.pi)
    for i in range(count):
        f = 0.30 + 0.66 * (i + rng.uniform(-0.25, 0.25)) / (count - 1)
        f = float(np.clip(f, 0.27, 0.97))
        azimuth += 2.39996 + rng.normal(0.0, 0.25)
        rise = np.radians(rng.uniform(18, 38) + 30 * max(0.0, f - 0.45))
        length = size * (1.10 - 0.55 * f) * rng.uniform(0.9, 1.1)
        branches += _limb(rng, trunk, f, azimuth, rise, length, size=size)
    return branches + side_shoots(rng, trunk, size, first=0.72)


FLATNESS = 0.35
"""Depth of a wall, as a share of an untrained tree."""


def _wall(rng: np.random.Generator, size: float) -> list[Branch]:
    """A leader with tiers of level limbs to both sides, all pressed into the plane of the row."""
    trunk = _trunk(rng, size, height=1.7)
    branches = [trunk]
    for tier in np.linspace(0.3, 0.93, 5):
        for side in (0.0, np.pi):
            f = float(np.clip(tier + rng.normal(0.0, 0.015), 0.2, 0.97))
            azimuth, rise = side + rng.normal(0.0, 0.06), np.radians(rng.uniform(2, 14))
            length = size * rng.uniform(0.9, 1.05)
            branches += _limb(rng, trunk, f, azimuth, rise, length, size=size, droop=0.5)
    branches += side_shoots(rng, trunk, size, first=0.8)
    return [replace(b, points=b.points * [1.0, FLATNESS, 1.0]) for b in branches]


def _vase(rng: np.random.Generator, size: float) -> list[Branch]:
    """A short trunk and steep limbs around an open centre; shoots towards the centre are removed."""
    trunk = _trunk(rng, size, height=0.5, thickness=0.052)
    branches = [trunk]
    count = int(rng.integers(5, 7))
    start = rng.uniform(0, 2 * np.pi)
    for i in range(count):
        azimuth = start + 2 * np.pi * i / count + rng.normal(0.0, 0.12)
        f, rise = rng.uniform(0.8, 0.98), np.radians(rng.uniform(46, 58))
        length = size * rng.uniform(1.35, 1.6)
        limb, *rest = _limb(rng, trunk, f, azimuth, rise, length, size=size, droop=0.7, thickest=0.032)
        branches += [limb, *(b for b in rest if _is_clear_of_centre(b, limb))]
    return branches


def _is_clear_of_centre(shoot: Branch, limb: Branch) -> bool:
    """Whether a shoot ends no nearer to the trunk's axis than four fifths of the distance of its limb at that
    height."""
    tip = shoot.points[-1]
    nearest = limb.points[int(np.abs(limb.points[:, 2] - tip[2]).argmin())]
    return bool(np.hypot(tip[0], tip[1]) > 0.8 * np.hypot(nearest[0], nearest[1]))


def _grow_bush(rng: np.random.Generator, size: float) -> list[Branch]:
    """Grow several low stems from one base."""
    stool = _trunk(rng, size, height=0.1, thickness=0.05)
    branches = [stool]
    count = int(rng.integers(7, 10))
    start = rng.uniform(0, 2 * np.pi)
    for i in range(count):
        azimuth = start + 2.39996 * i + rng.normal(0.0, 0.2)
        rise = np.radians(rng.uniform(48, 66) + (18 if i == 0 else 0))
        length = size * rng.uniform(1.25, 1.6)
        branches += _limb(rng, stool, 0.6, azimuth, rise, length, size=size, droop=0.9, thickest=0.02)
    return branches
