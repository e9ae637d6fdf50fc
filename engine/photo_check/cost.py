"""Approximate time and memory of a run, before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..child_process import usable_cores
from ..config import Config
from ..language.encoders.embedded import MAX_SIDE
from ..memory import camera_search_bytes, largest_copy, stage_bytes
from ..scene.camera import Camera
from ..scene.walk import SECTION_PHOTOS

# Measured on two shared cores, where equal runs differ by up to a factor of two: 300 photos of 1600×1200 trained for
# 1200 steps in 141 s, got features in 811 s and were counted in 8 s; 60 photos of 480×360 trained in 51 s.
SEARCH_SECONDS = 2.8
"""Seconds per photo of finding cameras."""
STEP_SECONDS, STEP_MEGAPIXEL_SECONDS = 0.035, 0.078
"""Seconds per step of training, and in addition per megapixel of a photo."""
FEATURE_SECONDS = 1.41
"""Seconds per photo and megapixel of computing features."""
COUNT_SECONDS = 8.0
"""Seconds of counting."""
SECTION_OVERLAP = 1.5
"""Photos that the sections of a row have together, relative to those of the row: two rows of 200 photos had 1.47."""
MEASURED_CORES = 2


@dataclass(frozen=True, kw_only=True)
class StageCost:
    """Approximate seconds and peak memory in bytes of a stage."""

    stage: str
    seconds: float
    bytes: int


def expected_costs(
    sizes: Sequence[tuple[int, int]], config: Config, *, posed: bool, cores: int | None = None
) -> list[StageCost]:
    """The cost of each stage; more cores than two are assumed to help in proportion.

    sizes: (width, height) of the photos; posed: their cameras are given; cores: of this computer if not given.
    """
    if not sizes:
        return []
    cores = cores or usable_cores()
    cameras = [_camera(*size, config) for size in sizes]
    seconds = {
        "training": _training_seconds(cameras, config),
        "computing features": FEATURE_SECONDS * sum(_megapixels(camera, MAX_SIDE) for camera in cameras),
        "counting": COUNT_SECONDS,
    }
    needed = stage_bytes(config.train.max_gaussians, config, cameras, trained=True)
    if not posed:
        seconds = {"finding cameras": SEARCH_SECONDS * len(sizes)} | seconds
        largest = largest_copy(sizes, config.photos.max_side)
        needed["finding cameras"] = camera_search_bytes(len(sizes), largest, 1)  # more threads only if they fit
    return [
        StageCost(stage=stage, seconds=value * MEASURED_CORES / cores, bytes=needed[stage])
        for stage, value in seconds.items()
    ]


def _camera(width: int, height: int, config: Config) -> Camera:
    """A camera with a photo of the size that training reads."""
    limit = config.scene.max_side or max(width, height)
    share = min(1.0 / config.scene.downscale, limit / max(width, height))
    return Camera(np.eye(3), np.eye(4), max(round(width * share), 1), max(round(height * share), 1))


def _megapixels(camera: Camera, max_side: int) -> float:
    """Of a photo scaled down to this longer side."""
    share = min(1.0, max_side / max(camera.width, camera.height))
    return camera.width * camera.height * share**2 / 1e6


def _training_seconds(cameras: Sequence[Camera], config: Config) -> float:
    """The first steps train on photos of half the width and height; a row of trees is trained in sections."""
    mean = sum(camera.width * camera.height for camera in cameras) / len(cameras) / 1e6
    whole = 1.0 - 0.75 * config.train.coarse_until
    longer = SECTION_OVERLAP * len(cameras) / SECTION_PHOTOS if _in_sections(len(cameras), config) else 1.0
    return longer * config.train.steps * (STEP_SECONDS + STEP_MEGAPIXEL_SECONDS * mean * whole)


def _in_sections(photos: int, config: Config) -> bool:
    """Whether the settings say that the photos show a row, and they are so many that it is trained in sections."""
    trees = max(config.count.trees, len(config.count.tree_places or ()) // 3)
    return trees > 1 and config.scene.sections != 1 and photos > SECTION_PHOTOS
