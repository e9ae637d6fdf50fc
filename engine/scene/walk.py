"""A long walk or flight along a row of trees: what its photos look at, and how it is cut into sections."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import ConfigError
from .camera import Camera, Scene

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SECTION_PHOTOS = 70
"""Photos of a section of a long walk, without those that overlap: about as many as of a single tree, so that a row gets
as many steps and Gaussians for each of its trees."""
NEAR = 30.0
"""Percentile of the depths of the points in a photo that is taken as the distance of what it looks at: behind the trees
there are more points than before them."""
SHIFT = 0.2
"""Share of a cell's length by which its border may move to where there is least."""
STEP = 0.1
"""Step of that search, in half widths of a photo."""
FEWEST = 4
"""Photos that a section has at least."""


@dataclass(frozen=True, eq=False)
class Section:
    """Part of a walk. low, high: ends of its cell along the walk's axis, scene units, infinite at the ends of the walk;
    photos: (P,) those that show something of the cell, ascending."""

    low: float
    high: float
    photos: IntArray


@dataclass(frozen=True, eq=False)
class Walk:
    """A walk that is cut into sections along `axis`, (3,) unit, in the scene frame. looks: (V,) where along it the
    middle of each photo lies, scene units."""

    axis: FloatArray
    looks: FloatArray
    sections: tuple[Section, ...]

    def cells(self, points: FloatArray) -> IntArray:
        """(N,) the section in whose cell each point (N, 3) lies; a border belongs to the later one."""
        return self._cells(points @ self.axis)

    @property
    def owners(self) -> IntArray:
        """(V,) the section in whose cell the middle of each photo lies."""
        return self._cells(self.looks)

    def _cells(self, places: FloatArray) -> IntArray:
        borders = np.array([section.low for section in self.sections[1:]])
        return np.searchsorted(borders, places, side="right").astype(np.int64)


def cut_walk(scene: Scene, *, photos: int, sections: int = 0) -> Walk | None:
    """Cut the walk along which photos were taken into sections of equally many photos; None if it is not to be cut.

    A cell is at least as long as a photo is wide, so photos around one tree are never cut: all of them show its cell.
    Borders lie where there is least, such as between two trees.

    Args:
        photos: number of a section, without those that overlap; sections: their number, 0 to choose it.

    Raises:
        ConfigError: the photos show too short a part of a row for this number of sections.
    """
    wanted = sections or math.ceil(len(scene.cameras) / photos)
    points = np.asarray(scene.points, np.float64)
    distance = _distance(scene.cameras, points) if wanted > 1 else None
    if distance is None:
        return None
    looked = np.stack([camera.center + distance * camera.forward for camera in scene.cameras])
    axis = _axis(looked, scene.up)
    half = float(np.median([_half_width(camera, axis, distance) for camera in scene.cameras]))
    looks = looked @ axis
    most = int(np.ptp(np.percentile(looks, [2.0, 98.0])) / (2.0 * half))
    if sections > most:
        raise ConfigError(
            f"--scene.sections is {sections}, and the photos show at most {max(most, 1)} parts of a row that are as "
            f"long as a photo is wide. Use {'at most ' + str(most) if most > 1 else '0 or 1'}"
        )
    count = min(wanted, most, len(looks) // FEWEST)
    if count <= 1:
        return None
    borders = _borders(looks, points @ axis, count, STEP * half)
    if not borders:
        return None
    ends = np.array([-np.inf, *borders, np.inf])
    found = [
        Section(float(low), float(high), np.flatnonzero((looks >= low - half) & (looks <= high + half)))
        for low, high in itertools.pairwise(ends)
    ]
    return Walk(axis, looks, tuple(found))


def _distance(cameras: Sequence[Camera], points: FloatArray) -> float | None:
    """How far away what the photos show is, scene units; None without points in them."""
    depths = []
    for camera in cameras:
        inside, _, depth = camera.find_in_frame(points)
        if inside.any():
            depths.append(float(np.percentile(depth[inside], NEAR)))
    return float(np.median(depths)) if depths else None


def _axis(looked: FloatArray, up: FloatArray) -> FloatArray:
    """(3,) unit, level: along which what the photos look at (V, 3) spreads most, towards the later photos."""
    level = looked - np.outer(looked @ up, up)
    axis: FloatArray = np.linalg.svd(level - level.mean(axis=0), full_matrices=False)[2][0]
    along = level @ axis
    ahead = float(np.arange(len(along)) @ (along - along.mean()))
    if abs(ahead) < 1e-9 * len(along) * float(np.ptp(along)):  # there and back
        ahead = float(axis[np.abs(axis).argmax()])
    return axis if ahead >= 0.0 else -axis


def _half_width(camera: Camera, axis: FloatArray, distance: float) -> float:
    """Half the length along the axis that the photo shows at a distance, scene units."""
    across = np.abs(camera.world_to_camera[:2, :3] @ axis)
    size = np.array([camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]])
    return 0.5 * distance * float(across @ size)


def _borders(looks: FloatArray, places: FloatArray, count: int, step: float) -> list[float]:
    """The borders between cells of equally many photos, moved to where there are fewest of the points at `places`."""
    even = np.quantile(looks, np.arange(1, count) / count)
    ends = np.array([looks.min(), *even, looks.max()])
    ordered, borders = np.sort(places), []
    for before, border, after in zip(ends, even, ends[2:], strict=False):
        room = SHIFT * min(border - before, after - border)
        tried = border + np.arange(-int(room / step), int(room / step) + 1) * step
        near = np.searchsorted(ordered, [tried - step, tried + step])
        crowd = near[1] - near[0]
        borders.append(float(tried[np.lexsort((np.abs(tried - border), crowd))[0]]))
    return _keep_apart(borders, looks)


def _keep_apart(borders: Sequence[float], looks: FloatArray) -> list[float]:
    """Return the borders without those between which too few photos look, as where many were taken at one place."""
    kept, ordered, used = list[float](), np.sort(looks), 0
    for border in borders:
        before = int(np.searchsorted(ordered, border))
        if before - used >= FEWEST and len(ordered) - before >= FEWEST:
            kept.append(border)
            used = before
    return kept
