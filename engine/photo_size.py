"""How large photos are read: whether fruit are wide enough in them, and what reading them larger costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .config import Config
from .counting.accounts.zero import ENOUGH_PIXELS
from .counting.evidence.picture_size import Regions, common_width
from .counting.evidence.pixel_width import focal_length
from .language.encoders.encoder import CropEncoder, DenseEncoder, sees_whole
from .language.encoders.seen import MOST as MOST_ENLARGED
from .language.prompts.relevancy import answer
from .memory import available_bytes, stage_bytes
from .progress import Progress, silent
from .scene.camera import Camera, Photo, Scene
from .scene.photos.photo import FilePhoto
from .splatting.training.schedule import grow_settings

FloatArray = NDArray[np.float64]
Pixels = NDArray[np.uint8]

NARROW = 12.0
"""Median width of the fruit in pixels below which photos that were scaled down are read larger, to `ENOUGH_PIXELS`."""
MOST = 2.0
"""Largest factor by which photos are read larger without being asked."""
MEASURED = 4
"""Number of photos in which fruit are measured before training."""
FIRST_SIDES = (1600, 3200, 800, 400)
"""Longer sides at which the encoder first sees these photos, one after the other until they show fruit."""
ROUNDS, SETTLED = 4, 0.04
"""How often fruit are measured again at the size for the width that was found, and the change of its logarithm that
ends this."""
WORD, THRESHOLD = "fruit", 0.5
"""What is measured, whatever the prompt is, because the Gaussians serve every prompt; and its least probability."""
FREE = 0.8
"""Share of the free memory that reading larger may use."""
CLOSER = "Take photos from nearer, of a part of the tree each, or with more pixels"
"""What to do if fruit are narrow in the files themselves."""
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


def find_scaled_down(photos: Sequence[Photo]) -> list[FilePhoto]:
    """Find the photos whose files are larger than they were read."""
    factors = growth(photos)
    return [
        photo for photo, factor in zip(photos, factors, strict=True) if factor > 1.0 and isinstance(photo, FilePhoto)
    ]


def fruit_angle(
    photos: Sequence[Photo], cameras: Sequence[Camera], encoder: DenseEncoder, progress: Progress = silent
) -> float | None:
    """The most common width of fruit in some of the photos, over their focal lengths; None if they show few."""
    progress(0.0, "Measuring the width of fruit in a few photos")
    chosen = choose_some(len(photos))
    return fruit_width(
        [photos[index].pixels() for index in chosen], [focal_length(cameras[index]) for index in chosen], encoder
    )


def choose_some(count: int) -> list[int]:
    """Choose which of so many photos are measured."""
    return [int(index) for index in np.unique(np.linspace(0, count - 1, MEASURED).round())]


def fruit_width(pixels: Sequence[Pixels], units: Sequence[float], encoder: DenseEncoder) -> float | None:
    """The most common width of fruit in photos (H, W, 3), sRGB, in the unit of each photo, given in pixels; None if
    they show few.

    The encoder sees the photos again at the scale for the width that was found, until the width changes little. On the
    sample orchard, read at 160 to 480 pixels a side, it is between 8 % below and 6 % above that of the counted fruit.
    """
    first = [tuple((min(side / max(photo.shape), MOST_ENLARGED),) for photo in pixels) for side in FIRST_SIDES]
    tried = (_measure_width(pixels, units, scales, encoder) for scales in dict.fromkeys(first))
    width = next((each for each in tried if each is not None), None)
    if width is None:
        return None
    for _ in range(ROUNDS):
        scales = [
            encoder.scales_of(photo.shape[0], photo.shape[1], width * unit)
            for photo, unit in zip(pixels, units, strict=True)
        ]
        finer = _measure_width(pixels, units, scales, encoder)
        if finer is None or abs(np.log(finer / width)) < SETTLED:
            break
        width = finer
    return width


def photo_scales(
    scene: Scene, encoder: DenseEncoder | CropEncoder, progress: Progress = silent
) -> list[Sequence[float]]:
    """The scales at which an encoder sees each photo of a scene, by the width of the fruit in some of them; none if it
    does not process whole photos."""
    if not sees_whole(encoder):
        return []
    return scales_for(scene.cameras, fruit_angle(scene.images, scene.cameras, encoder, progress), encoder)


def scales_for(cameras: Sequence[Camera], angle: float | None, encoder: DenseEncoder) -> list[Sequence[float]]:
    """The scales at which an encoder sees the photo of each camera; angle: see `fruit_angle`."""
    return [
        encoder.scales_of(camera.height, camera.width, None if angle is None else angle * focal_length(camera))
        for camera in cameras
    ]


def _measure_width(
    pixels: Sequence[Pixels], units: Sequence[float], scales: Sequence[Sequence[float]], encoder: DenseEncoder
) -> float | None:
    """Measure the width of fruit in photos, in their units, as an encoder sees them at these scales."""
    found = []
    for photo, unit, own in zip(pixels, units, scales, strict=True):
        features = encoder.encode_dense(photo, own)
        regions = Regions.of(answer(features, encoder.questions(WORD)).numpy() >= THRESHOLD)
        pixel = max(photo.shape) / max(features.shape[:2]) / unit
        found.append((regions.widths, np.full(len(regions.widths), pixel), regions.areas, regions.single))
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
    larger = [camera.scale(factor) for camera, factor in zip(cameras, growth(photos, side), strict=True)]
    gaussians = grow_settings(config.train, larger, len(larger)).max_gaussians
    return max(stage_bytes(gaussians, config, larger, trained=True).values())


def width_notices(
    pixel_width: float | None, photos: Sequence[Photo], cameras: Sequence[Camera], config: Config
) -> list[str]:
    """A message with what to do if fruit are too narrow: with the setting that reads the photos larger if most were
    scaled down.

    pixel_width: median width of the fruit in pixels of the photos as they were read, None if it is not known.
    """
    if pixel_width is None or pixel_width >= NARROW:
        return []
    small = f"the fruit are {pixel_width:.0f} pixels wide in the photos as read, and {ENOUGH_PIXELS:.0f} are needed"
    reduced = find_scaled_down(photos)
    if not reduced or 2 * len(reduced) < len(photos):
        return [f"{small}: fruit may be missing. {CLOSER}"]
    read = max(max(photo.width, photo.height) for photo in reduced)
    longest = max(max(photo.header.width, photo.header.height) for photo in reduced)
    side = min(-int(-read * ENOUGH_PIXELS / pixel_width // STEP) * STEP, longest)
    factor = float(np.median(growth(photos, side)))
    flags = f"--scene.max-side {side}" + (" --scene.downscale 1" if config.scene.downscale > 1.0 else "")
    needed = needed_bytes(side, photos, cameras, config)
    return [
        f"{small}. {flags} makes them {factor * pixel_width:.0f} pixels wide; it needs about "
        f"{needed / 2**30:.1f} GB of memory and up to {factor**2:.1f} times the time"
    ]
