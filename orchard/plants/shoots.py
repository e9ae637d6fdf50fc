"""Shapes of wood: curved lines, side branches and twigs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..shapes.branch import UP, Branch, to_unit

FloatArray = NDArray[np.float64]


def path(
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
    """(steps + 1, 3) a line that first grows upward (lift) and bends down towards its loaded end (droop)."""
    points = [start]
    d = to_unit(direction)
    drift = rng.normal(0.0, wander, 3)
    for i in range(steps):
        s = (i + 0.5) / steps
        drift = 0.6 * drift + rng.normal(0.0, wander, 3)
        d = to_unit(d + drift + UP * (lift * (1 - s) - droop * s) / steps)
        points.append(points[-1] + d * length / steps)
    return np.array(points)


def taper(base: float, tip: float, count: int) -> FloatArray:
    """(count,) half thickness from the base to the tip."""
    return tip + (base - tip) * (1.0 - np.linspace(0.0, 1.0, count)) ** 0.8


def sideways(rng: np.random.Generator, along: FloatArray, turn: float, angle: float) -> FloatArray:
    """A direction at an angle from `along`, rotated around it."""
    a = to_unit(np.cross(along, UP + rng.normal(0.0, 0.05, 3)))
    b = np.cross(a, along)
    return np.cos(angle) * along + np.sin(angle) * (np.cos(turn) * a + np.sin(turn) * b)


def side_shoots(rng: np.random.Generator, limb: Branch, size: float, first: float = 0.2) -> list[Branch]:
    """Branches on a limb, alternating sides, each with twigs, and twigs on the limb itself."""
    shoots: list[Branch] = []
    number = int(np.clip(round(limb.span * (1 - first) / (0.105 * size)), 2, 8))
    turn = rng.uniform(0, 2 * np.pi)
    for j in range(number):
        f = first + (1 - first) * (j + rng.uniform(0.2, 0.8)) / number
        base, along = limb.at(f)
        turn += np.pi + rng.normal(0.0, 0.6)
        direction = sideways(rng, along, turn, np.radians(rng.uniform(38, 65))) + UP * 0.15
        length = size * rng.uniform(0.26, 0.44) * (1.1 - 0.45 * f)
        branch = Branch(
            points=path(rng, base, direction, length, steps=8, wander=0.09, lift=0.5, droop=1.0),
            radii=taper(min(0.6 * limb.radius_at(f), 0.0075 * size**0.5), 0.0024 * size**0.5, 9),
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
        direction = sideways(rng, along, turn, np.radians(rng.uniform(35, 70))) + UP * 0.2
        reach = size * length * rng.uniform(0.6, 1.3)
        twigs.append(
            Branch(
                points=path(rng, base, direction, reach, steps=5, wander=0.1, lift=0.4, droop=0.6),
                radii=taper(min(0.7 * parent.radius_at(f), 0.0030 * size**0.5), 0.0014 * size**0.5, 6),
                generation=3,
            )
        )
    return twigs
