"""Approximate time and memory of a run, before it starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..child_process import usable_cores
from ..config import Config
from ..language.encoders.seen import scales_of
from ..memory import camera_search_bytes, largest_copy, stage_bytes
from ..scene.camera import Camera
from ..scene.walk import SECTION_PHOTOS
from ..splatting.training.schedule import grow_settings

# Measured on two shared cores, where equal runs differ by up to a factor of two: 300 photos of 1600×1200 trained for
# 1200 steps in 141 s, got features in 811 s and were counted in 8 s; 60 photos of 480×360 trained in 51 s.
SEARCH_SECONDS = 2.8
"""Seconds per photo of finding cameras."""
STEP_SECONDS, STEP_MEGAPIXEL_SECONDS = 0.035, 0.078
"""Seconds per step of training, and in addition per megapixel of a photo."""
FEATURE_SECONDS = 0.8
"""Seconds of computing features per megapixel that the encoder sees."""
USUAL_FRUIT = 0.0175
"""Width of fruit that is assumed if it is not known, as a share of the longer side: an apple on a whole tree."""
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


def estimate_costs(
    sizes: Sequence[tuple[int, int]],
    config: Config,
    *,
    posed: bool,
    fruit: float | None = None,
    cores: int | None = None,
) -> list[StageCost]:
    """Estimate the cost of each stage; more cores than two are assumed to help in proportion.

    sizes: (width, height) of the photos; posed: their cameras are given; fruit: their width as a share of the longer
    side of a photo, None if it is not known; cores: of this computer if not given.
    """
    if not sizes:
        return []
    cores = cores or usable_cores()
    cameras = [_camera(*size, config) for size in sizes]
    photos = 0 if _in_sections(len(cameras), config) else len(cameras)  # a section has the usual number of photos
    config = replace(config, train=grow_settings(config.train, cameras, photos))
    seconds = {
        "training": _training_seconds(cameras, config),
        "computing features": FEATURE_SECONDS * sum(_count_megapixels(camera, fruit) for camera in cameras),
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


def side_read(side: float, config: Config) -> float:
    """The longer side in pixels at which photos with this longer side are read."""
    return min(side / config.scene.downscale, config.scene.max_side or side)


def _camera(width: int, height: int, config: Config) -> Camera:
    """A camera with a photo of the size that training reads."""
    share = side_read(max(width, height), config) / max(width, height)
    return Camera(np.eye(3), np.eye(4), max(round(width * share), 1), max(round(height * share), 1))


def _count_megapixels(camera: Camera, fruit: float | None) -> float:
    """Count the megapixels of a photo as the encoder sees it."""
    width, height = camera.width, camera.height
    share = USUAL_FRUIT if fruit is None else fruit
    scales = scales_of(height, width, share * max(width, height))
    return sum(scale**2 for scale in scales) * width * height / 1e6


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
