"""How large photos are read: whether fruit are wide enough in them, and what reading them larger costs."""

from __future__ import annotations

from collections.abc import Sequence

from .config import Config
from .memory import stage_bytes
from .scene.camera import Camera, Photo
from .scene.photos.photo import FilePhoto

WANTED = 14.0
"""Median width of the fruit in pixels that counting needs; that of the ladder's scenes."""
STEP = 20
"""Advised sizes are multiples of this many pixels."""


def reduction(photos: Sequence[Photo]) -> float:
    """How many times as wide the photos' files are as they were read; 1 if they were not scaled down."""
    files = [photo for photo in photos if isinstance(photo, FilePhoto)]
    shares = [max(each.header.width, each.header.height) / max(each.width, each.height) for each in files]
    return max(1.0, min(shares, default=1.0))


def width_notices(
    pixel_width: float | None, photos: Sequence[Photo], cameras: Sequence[Camera], config: Config
) -> list[str]:
    """A message with the setting that reads the photos larger, if they were scaled down until fruit became too narrow.

    pixel_width: median width of the fruit in pixels of the photos as they were read, None if it is not known.
    """
    possible = reduction(photos)
    if pixel_width is None or pixel_width >= WANTED or possible <= 1.0:
        return []
    read = max(max(photo.width, photo.height) for photo in photos if isinstance(photo, FilePhoto))
    side = min(-int(-read * WANTED / pixel_width // STEP) * STEP, round(read * possible))
    factor = side / read
    flags = f"--scene.max-side {side}" + (" --scene.downscale 1" if config.scene.downscale > 1.0 else "")
    larger = [camera.scaled(factor) for camera in cameras]
    needed = max(stage_bytes(config.train.max_gaussians, config, larger, trained=True).values())
    return [
        f"the fruit are {pixel_width:.0f} pixels wide in the photos as read, and {WANTED:.0f} are needed. {flags} "
        f"makes them {factor * pixel_width:.0f} pixels wide; it needs about {needed / 2**30:.1f} GB of memory and up "
        f"to {factor**2:.1f} times the time"
    ]
