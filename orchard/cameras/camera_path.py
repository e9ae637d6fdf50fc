"""The camera path: around the trees, half around them, along their row, or around a part of a crown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..config import ALONG, OrchardConfig
from ..species import Species
from .aim import Part
from .viewpoint import Viewpoint, look_at

FloatArray = NDArray[np.float64]
NEAREST = 2.3
"""Least distance of the path from the line of the row, in heights of the tree ÷ 2, to stay clear of the crown."""
CLEARANCE = 1.75
"""The same in half widths of the crown."""
ARCS = {"ring": 75.0, "wave": 75.0, "half-ring": 40.0}
"""Angle to each side of a path around a part of a crown, degrees."""
WAVES = 3
"""Number of waves of the height: neighbouring pictures stay similar, which estimating the cameras needs."""
LEVELS = -0.25, 0.55
"""Lowest and highest camera, in crown heights above the middle of the crown."""
RISES = -8.0, 26.0
"""The same for a part of a crown, degrees."""
SLOPE = 40.0
"""Angle by which the camera of a flight looks down, degrees."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """What a camera path leads around."""

    crown: FloatArray
    """(2, 3) low and high corner of all crowns of the row."""
    half_row: float
    """Half the distance from the first trunk of the row to the last, metres."""
    part: Part | None
    """The part of the crown to look at; None: all of it."""


@dataclass(frozen=True, kw_only=True)
class CameraPlace:
    """Position and target of a picture, before camera shake."""

    place: FloatArray
    target: FloatArray


def plan_views(rng: np.random.Generator, config: OrchardConfig, species: Species, place: Place) -> list[Viewpoint]:
    """Plan the views of the configured path, with random variation of position and target; one focal length for all."""
    size = species.tree_height / 2.3
    if place.part is not None:
        distance = 0.6 * species.tree_height
        stands = [_place_before_part(rng, config, place.part, distance, i) for i in range(config.views)]
        shake = 0.25 * place.part.reach
    else:
        distance = distance_from_row(species, place) + (0.0 if config.path in ALONG else place.half_row)
        step = _place_along_row if config.path in ALONG else _place_around
        stands = [step(rng, config, place, distance, i) for i in range(config.views)]
        shake = 0.05 * size
    focal = config.fruit_pixels * distance / species.diameter
    views = []
    for i, stand in enumerate(stands):
        position = stand.place + rng.normal(0.0, 0.05, 3) * [0, 0, size]
        target = stand.target + rng.normal(0.0, 1.0, 3) * shake
        views.append(
            Viewpoint(
                name=f"{i + 1:03d}.jpg",
                focal=focal,
                width=config.width,
                height=config.height,
                world_to_camera=look_at(position, target, rng.normal(0.0, 0.01)),
            )
        )
    return views


def distance_from_row(species: Species, place: Place) -> float:
    """Distance of the camera from the line of the row, metres."""
    low, high = place.crown
    half_width = max((high - low)[1], (high - low)[0] - 2 * place.half_row) / 2
    return max(NEAREST * species.tree_height / 2, CLEARANCE * half_width)


def _middle(place: Place) -> FloatArray:
    low, high = place.crown
    middle: FloatArray = (low + high) / 2 + [0.0, 0.0, 0.05 * (high[2] - low[2])]
    return middle


@dataclass(frozen=True, kw_only=True)
class _Step:
    """Position of a picture on the path: share of the path, and of the climb from the lowest to the highest camera."""

    share: float
    climb: float


def _step(rng: np.random.Generator, config: OrchardConfig, i: int) -> _Step:
    """The i-th step of the path: heights alternate on rings, and follow each other on a wave."""
    if config.path == "wave":
        share = (i + 0.5 + rng.uniform(-0.15, 0.15)) / config.views
        return _Step(share=share, climb=0.5 - 0.5 * np.cos(2 * np.pi * WAVES * share))
    along = config.path in ALONG
    ring, place = divmod(i, _count_per_ring(config)) if along else (i % config.rings, i // config.rings)
    share = (place + 0.5 + rng.uniform(-0.15, 0.15)) / _count_per_ring(config)
    if not along:  # those of one ring are between those of another
        share += (ring / config.rings - 0.5) / _count_per_ring(config)
    return _Step(share=share, climb=float(np.linspace(0.0, 1.0, config.rings)[ring]))


def _count_per_ring(config: OrchardConfig) -> int:
    return -(-config.views // config.rings)


def _level(place: Place, climb: float) -> float:
    """Height of the camera."""
    tall = place.crown[1, 2] - place.crown[0, 2]
    return float(_middle(place)[2] + tall * np.interp(climb, [0.0, 1.0], LEVELS))


def _place_around(
    rng: np.random.Generator, config: OrchardConfig, place: Place, distance: float, i: int
) -> CameraPlace:
    """Place the i-th picture of a path around the trees or half around them."""
    step = _step(rng, config, i)
    turn = np.pi + np.pi * step.share if config.path == "half-ring" else 2 * np.pi * step.share
    away = distance * rng.uniform(0.95, 1.05)
    middle = _middle(place)
    x, y = middle[:2] + away * np.array([np.cos(turn), np.sin(turn)])
    return CameraPlace(place=np.array([x, y, _level(place, step.climb)]), target=middle)


def _place_along_row(
    rng: np.random.Generator, config: OrchardConfig, place: Place, distance: float, i: int
) -> CameraPlace:
    """Place the i-th picture of a path along the row, to at the first height, back at the second, and so on; of a
    flight obliquely from above, to on one side of the row and back on the other."""
    step = _step(rng, config, i)
    back = i // _count_per_ring(config) % 2 == 1
    low, high = place.crown[:, 0]
    middle = _middle(place)
    x = low + (high - low) * (1 - step.share if back else step.share)
    yaw = np.radians(rng.uniform(-12, 12))
    away = distance * rng.uniform(0.97, 1.03)
    target = np.array([x + away * np.tan(yaw), middle[1], middle[2]])
    if config.path == "flight":
        slope = np.radians(SLOPE)
        up = away * np.array([0.0, (1.0 if back else -1.0) * np.cos(slope), np.sin(slope)])
        return CameraPlace(place=np.array([x, middle[1], middle[2]]) + up, target=target)
    return CameraPlace(place=np.array([x, middle[1] - away, _level(place, step.climb)]), target=target)


def _place_before_part(
    rng: np.random.Generator, config: OrchardConfig, part: Part, distance: float, i: int
) -> CameraPlace:
    """Place the i-th picture of arcs before a part of the crown."""
    step = _step(rng, config, i)
    turn = np.radians(ARCS[config.path] * (2 * step.share - 1))
    rise = np.radians(np.interp(step.climb, [0.0, 1.0], RISES))
    away = distance * rng.uniform(0.95, 1.05)
    direction = np.array([np.sin(turn) * np.cos(rise), -np.cos(turn) * np.cos(rise), np.sin(rise)])
    return CameraPlace(place=part.center + away * direction, target=part.center)
