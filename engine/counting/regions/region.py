"""The region of a scene in which fruit are counted: everything, a box, or an outline seen from above."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...config import CountConfig
from ...errors import ConfigError
from ..evidence.cluster import Clusters

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

REACH = 2.0
"""Mean diameters around a region from which points are used, so that no fruit at its border is cut."""
LEAST_AREA = 1e-9
"""Least area of an outline, as a share of the square around it; with less it is a line."""


class Region(Protocol):
    """The part of the scene frame in which fruit are counted."""

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        """(N,) whether each of the points (N, 3) lies inside or no farther outside than `margin`, scene units."""
        ...


@dataclass(frozen=True)
class Everywhere:
    """All of space."""

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        return np.ones(len(points), bool)


@dataclass(frozen=True, eq=False)
class Box:
    """low, high: (3,) opposite corners, along the axes of the scene's frame; its border belongs to it."""

    low: FloatArray
    high: FloatArray

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        return ((points >= self.low - margin) & (points <= self.high + margin)).all(axis=1)


@dataclass(frozen=True, eq=False)
class Prism:
    """Everything between two heights over and under an outline. axes: (2, 3) unit vectors of the level; corners: (C, 2)
    the outline along them, in order; up: (3,) unit; heights: lowest and highest p · up, infinite if not given."""

    axes: FloatArray
    corners: FloatArray
    up: FloatArray
    heights: tuple[float, float] = (-np.inf, np.inf)

    @staticmethod
    def over(corners: FloatArray, up: FloatArray, heights: tuple[float, float] | None = None) -> Prism:
        """The prism along unit `up` (3,) over the outline `corners` (C, 3), whose last corner may equal the first.

        Raises:
            ConfigError: the outline has no area or crosses itself.
        """
        axes = np.linalg.svd(up[None])[2][1:]
        level = corners @ axes.T
        level = level[(level != np.roll(level, 1, axis=0)).any(axis=1)]
        prism = Prism(axes, level, up, heights or (-np.inf, np.inf))
        size = np.ptp(corners, axis=0).max()
        if len(level) < 3 or abs(prism.area) <= LEAST_AREA * size**2:
            raise ConfigError("--count.polygon has no area seen from above. Give three or more corners not in line")
        if prism.crosses_itself():
            raise ConfigError("--count.polygon crosses itself. Give its corners in order around the outline")
        return prism

    @property
    def area(self) -> float:
        """Signed area, by the direction of the corners."""
        x, y = (self.corners - self.corners[0]).T
        return float(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())

    def crosses_itself(self) -> bool:
        """Whether two sides that are not neighbours cross."""
        starts, ends = self.corners, np.roll(self.corners, -1, axis=0)
        sides = len(starts)
        return any(
            _meet(starts[i], ends[i], starts[j], ends[j])
            for i in range(sides)
            for j in range(i + 2, sides)
            if (i, j) != (0, sides - 1)
        )

    def contains(self, points: FloatArray, margin: float = 0.0) -> BoolArray:
        x, y = (points @ self.axes.T).T
        inside, near = np.zeros(len(points), bool), np.full(len(points), np.inf)
        for (ax, ay), (bx, by) in zip(self.corners, np.roll(self.corners, -1, axis=0), strict=True):
            if ay != by:
                inside ^= ((ay > y) != (by > y)) & (x < ax + (bx - ax) * (y - ay) / (by - ay))
            if margin > 0.0:
                side = np.array([bx - ax, by - ay])
                along = np.clip(((x - ax) * side[0] + (y - ay) * side[1]) / (side @ side), 0.0, 1.0)
                near = np.minimum(near, np.hypot(x - ax - along * side[0], y - ay - along * side[1]))
        height, (low, high) = points @ self.up, self.heights
        return (inside | (near <= margin)) & (height >= low - margin) & (height <= high + margin)


def region_of(config: CountConfig, up: FloatArray) -> Region:
    """The region in the settings; up: (3,) away from the ground, in the scene frame.

    Raises:
        ConfigError: the outline has no area or crosses itself.
    """
    if config.box is not None:
        corners = np.array(config.box).reshape(2, 3)
        return Box(corners.min(axis=0), corners.max(axis=0))
    if config.polygon is not None:
        return Prism.over(np.array(config.polygon).reshape(-1, 3), up, config.heights)
    return Everywhere()


def keep_inside(clusters: Clusters, region: Region) -> Clusters:
    """The clusters without fruit whose centres lie outside, and without points outside that belong to no remaining
    fruit."""
    kept = region.contains(clusters.spheres.centers)
    shown = np.where(
        clusters.owners < 0, region.contains(clusters.points.positions), np.append(kept, True)[clusters.owners]
    )
    return clusters.keep(kept, shown, "its fruit lie outside the region")


def _meet(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    """Whether the sides a-b and c-d, (2,) each, have a point in common."""
    turns = [_turn(a, b, c), _turn(a, b, d), _turn(c, d, a), _turn(c, d, b)]
    if turns[0] * turns[1] < 0.0 and turns[2] * turns[3] < 0.0:
        return True
    touching = ((a, b, c), (a, b, d), (c, d, a), (c, d, b))
    return any(turn == 0.0 and _is_between(*corners) for turn, corners in zip(turns, touching, strict=True))


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """Positive where a, b, c turn left, 0 where they lie in a line."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _is_between(a: FloatArray, b: FloatArray, c: FloatArray) -> bool:
    """Whether c, on the line through a and b, lies between them."""
    return bool((c >= np.minimum(a, b)).all() and (c <= np.maximum(a, b)).all())


def format_position(place: FloatArray) -> str:
    """Write a position (3,) in the format of the flags."""
    return " ".join(f"{value:.3g}" for value in place)
