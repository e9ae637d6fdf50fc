"""How large photos are read: whether fruit are wide enough in them, and what reading them larger costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .config import Config
from .counting.accounts.zero import ENOUGH_PIXELS
from .counting.evidence.picture_size import Regions, common_width
from .language.encoders.encoder import DenseEncoder
from .language.prompts.relevancy import answer
from .memory import available_bytes, stage_bytes
from .scene.camera import Camera, Photo
from .scene.photos.photo import FilePhoto

FloatArray = NDArray[np.float64]

NARROW = 12.0
"""Median width of the fruit in pixels below which photos that were scaled down are read larger, to `ENOUGH_PIXELS`."""
MOST = 2.0
"""Largest factor by which photos are read larger without being asked."""
MEASURED = 4
"""Number of photos in which fruit are measured before training."""
WORD, THRESHOLD = "fruit", 0.5
"""What is measured, whatever the prompt is, because the Gaussians serve every prompt; and its least probability."""
FREE = 0.8
"""Share of the free memory that reading larger may use."""
STEP = 20
"""Advised sizes are multiples of this many pixels."""


def growth(photos: Sequence[Photo], side: float = np.inf) -> FloatArray:
    """(V,) how many times as wide each photo becomes if it is read with at most `side` pixels on its longer side; 1 if
    its file is no larger than it was read."""
    factors = np.ones(len(photos))
    for index, photo in enumerate(photos):
        if isinstance(photo, FilePhoto):
            longest = max(photo.header.width, photo.header.height)
            factors[index] = max(min(longest, side) / max(photo.width, photo.height), 1.0)
    return factors


def scaled_down(photos: Sequence[Photo]) -> list[FilePhoto]:
    """The photos whose files are larger than they were read."""
    factors = growth(photos)
    return [
        photo for photo, factor in zip(photos, factors, strict=True) if factor > 1.0 and isinstance(photo, FilePhoto)
    ]


def seen_width(photos: Sequence[Photo], encoder: DenseEncoder) -> float | None:
    """The most common width of fruit in some of the photos, in pixels as they are read; None if they show few.

    On the sample orchard, read at 160 to 480 pixels a side, it is between 8 % below and 6 % above the median width of
    the counted fruit.
    """
    chosen = np.unique(np.linspace(0, len(photos) - 1, MEASURED).round().astype(np.int64))
    found = []
    for photo in (photos[index] for index in chosen):
        pixels = photo.pixels()
        features = encoder.encode_dense(pixels)
        regions = Regions.of(answer(features, encoder.questions(WORD)).numpy() >= THRESHOLD)
        # The encoder may scale large photos down.
        scale = max(pixels.shape) / max(features.shape[:2])
        found.append((regions.widths, np.full(len(regions.widths), scale), regions.areas, regions.single))
    return common_width(*map(np.concatenate, zip(*found, strict=True)))


def side_to_read(
    width: float | None,
    photos: Sequence[Photo],
    cameras: Sequence[Camera],
    config: Config,
    *,
    free: int | None = None,
) -> int:
    """The `scene.max_side` at which fruit are wide enough: at most MOST times as large as it is, no larger than the
    files, and no larger than fits into memory.

    width: of the fruit in pixels in the photos that were scaled down, None if it is not known; photos, cameras: of the
    scene, in one order; free: usable bytes; `available_bytes` if not given.
    """
    side = config.scene.max_side
    if width is None or width >= NARROW:
        return side
    usable = FREE * (available_bytes() if free is None else free)
    largest = min(ENOUGH_PIXELS / width, MOST, float(growth(photos).max(initial=1.0)))
    for larger in range(int(largest * side) // STEP * STEP, side, -STEP):
        if needed_bytes(larger, photos, cameras, config) <= usable:
            return larger
    return side


def needed_bytes(side: float, photos: Sequence[Photo], cameras: Sequence[Camera], config: Config) -> int:
    """Peak memory of a run with photos that are read with at most `side` pixels on their longer side."""
    larger = [camera.scaled(factor) for camera, factor in zip(cameras, growth(photos, side), strict=True)]
    return max(stage_bytes(config.train.max_gaussians, config, larger, trained=True).values())


def width_notices(
    pixel_width: float | None, photos: Sequence[Photo], cameras: Sequence[Camera], config: Config
) -> list[str]:
    """A message with the setting that reads the photos larger, if most were scaled down and fruit became too narrow.

    pixel_width: median width of the fruit in pixels of the photos as they were read, None if it is not known.
    """
    reduced = scaled_down(photos)
    if pixel_width is None or pixel_width >= NARROW or not reduced or 2 * len(reduced) < len(photos):
        return []
    read = max(max(photo.width, photo.height) for photo in reduced)
    longest = max(max(photo.header.width, photo.header.height) for photo in reduced)
    side = min(-int(-read * ENOUGH_PIXELS / pixel_width // STEP) * STEP, longest)
    factor = float(np.median(growth(photos, side)))
    flags = f"--scene.max-side {side}" + (" --scene.downscale 1" if config.scene.downscale > 1.0 else "")
    needed = needed_bytes(side, photos, cameras, config)
    return [
        f"the fruit are {pixel_width:.0f} pixels wide in the photos as read, and {ENOUGH_PIXELS:.0f} are needed. "
        f"{flags} makes them {factor * pixel_width:.0f} pixels wide; it needs about {needed / 2**30:.1f} GB of memory "
        f"and up to {factor**2:.1f} times the time"
    ]
