"""The memory that each stage of a run needs, and whether it is available."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import psutil

from .child_process import usable_cores
from .config import Config
from .counting.evidence.visibility import scale_to_drawing_size
from .errors import ConfigError
from .language.encoders.seen import MOST, MOST_PIXELS, TILE
from .scene.camera import Camera
from .splatting.kernels.project_backward import MOMENT
from .splatting.kernels.records import RECORD
from .splatting.training.losses import REMEMBERED
from .splatting.training.photos import KEPT

BOTH_SIZES = 1.25
"""Pixels of a photo at full and at half size, in pixels of the photo."""
TILES_EACH = 6
"""Mean number of tiles per Gaussian and view: 3 to 5 were measured."""
STEP_PLANES = 40
"""float32 planes of a photo's size that a step of training keeps: blending, gradients, the loss's scratch."""
FEATURE_PLANES, TILE_PLANES = 190, 35
"""float32 planes, at the peak of encoding and lifting a photo, of the size of its features, and of a tile of what the
network sees: 2.53 GB were measured for photos of 1600×1200 that it sees twice as large."""
DECODED_BYTES = 12
"""Bytes per pixel of a photo while it is scaled down for the encoder."""
LIFTED_VALUES = 270
"""float32 values per Gaussian that lifting keeps: sums and features of all channels, and those of a view's tiles."""
MASK_BYTES = 120
"""Bytes per pixel of a photo while its masks are found, at three levels."""
DRAWN_BYTES = 29
"""Bytes per drawn pixel of all views at the peak of counting."""
SOUGHT_BYTES, SOUGHT_BASE = 27, 400 << 20
"""Bytes per drawn pixel of all views for what photos show while fruit are searched in them, and bytes of that search's
network."""
POINT_BYTES = 180
"""Bytes per sampled surface point at the peak of counting."""
COUNTED_VALUES = 130
"""float32 values per Gaussian while counting."""
SIFT_BYTES = 550
"""Bytes per pixel of a copy while its features are found, in each thread."""
SEARCHED_PHOTO = 2 << 20
"""Bytes per photo of its features and matches while cameras are placed."""
SEARCH_BASE = 250 << 20
"""Bytes of the process that finds cameras."""
BASE = 500 << 20
"""Bytes of the program itself, its libraries and the machine code."""
LEFT, LEFT_OF_PHOTOS = 150 << 20, 0.5
"""Bytes, and share of the photos' bytes, that a training leaves in use by the process."""


def training_bytes(gaussians: int, sh_degree: int, cameras: Sequence[Camera]) -> int:
    """Approximate peak memory of training, in bytes."""
    values = 11 + 3 * (sh_degree + 1) ** 2
    # Values, two moments, gradients, and a second copy of the first three while Gaussians are added.
    a_gaussian = 4 * (7 * values + RECORD + 8) + TILES_EACH * (4 * MOMENT + 12)
    pixels = [camera.width * camera.height for camera in cameras]
    moments = min(int(24 * BOTH_SIZES * sum(pixels)), REMEMBERED)
    photos = photo_bytes(cameras)
    return BASE + gaussians * a_gaussian + photos + moments + 4 * STEP_PLANES * max(pixels, default=0)


def photo_bytes(cameras: Sequence[Camera]) -> int:
    """Approximate bytes of photos and masks that training keeps in memory."""
    return min(int(4 * BOTH_SIZES * sum(camera.width * camera.height for camera in cameras)), KEPT)


def features_bytes(gaussians: int, config: Config, cameras: Sequence[Camera]) -> int:
    """Approximate peak memory of computing features, in bytes, without the weights of a CLIP or SAM checkpoint."""
    if config.embed.encoder == "clip":
        pixels = max(camera.width * camera.height for camera in cameras)
        return BASE + MASK_BYTES * pixels + 4 * LIFTED_VALUES * gaussians
    decoded = max(camera.width * camera.height for camera in cameras)
    encoded, tile = min(decoded, MOST_PIXELS // 4), min(decoded * MOST**2, TILE)
    planes = FEATURE_PLANES * encoded + TILE_PLANES * tile
    return int(BASE + DECODED_BYTES * decoded + 4 * planes + 4 * LIFTED_VALUES * gaussians)


def counting_bytes(gaussians: int, config: Config, cameras: Sequence[Camera]) -> int:
    """Approximate peak memory of counting, in bytes."""
    drawn = sum(camera.width * camera.height for camera in scale_to_drawing_size(cameras))
    points = min(config.count.sample_budget, 20 * gaussians)
    sought = 0 if config.embed.encoder == "clip" else SOUGHT_BASE + SOUGHT_BYTES * drawn
    return BASE + DRAWN_BYTES * drawn + sought + POINT_BYTES * points + 4 * COUNTED_VALUES * gaussians


def stage_bytes(gaussians: int, config: Config, cameras: Sequence[Camera], *, trained: bool) -> dict[str, int]:
    """{stage: approximate peak memory in bytes} of a run up to this number of Gaussians."""
    later = {
        "computing features": features_bytes(gaussians, config, cameras),
        "counting": counting_bytes(gaussians, config, cameras),
    }
    if not trained:
        return later
    training = {"training": training_bytes(gaussians, config.train.sh_degree, cameras)}
    left = LEFT + int(LEFT_OF_PHOTOS * photo_bytes(cameras))
    return training | {stage: size + left for stage, size in later.items()}


def largest_copy(sizes: Sequence[tuple[int, int]], max_side: int) -> int:
    """Pixels of the largest copy in which features of photos with these sizes (width, height) are searched."""
    return int(max(min(1.0, max_side / max(size)) ** 2 * size[0] * size[1] for size in sizes))


def camera_search_bytes(photos: int, pixels: int, threads: int) -> int:
    """Approximate peak memory of finding cameras, in bytes; pixels: of the largest copy of a photo.

    Features are found in a few copies at a time; later all copies are in memory in grey.
    """
    return SEARCH_BASE + photos * SEARCHED_PHOTO + max(threads * SIFT_BYTES, photos) * pixels


def camera_search_threads(
    sizes: Sequence[tuple[int, int]], max_side: int, *, cores: int | None = None, free: int | None = None
) -> int:
    """The threads with which a camera search fits into memory, at most one for each core.

    sizes: (width, height) of the photos; cores: those of the machine if not given.

    Raises:
        ConfigError: one thread needs more memory; says what would fit.
    """
    available, cores = available_bytes() if free is None else free, cores or usable_cores()
    largest = largest_copy(sizes, max_side)
    needed = camera_search_bytes(len(sizes), largest, 1)
    if needed > available:
        fitting = max(available - camera_search_bytes(len(sizes), 0, 1), 0) / (SIFT_BYTES * largest)
        smaller = int(max_side * fitting**0.5) // 100 * 100
        raise ConfigError(
            f"Finding the cameras of {len(sizes)} photos needs about {needed / 2**30:.1f} GB of memory and "
            f"{available / 2**30:.1f} GB are free. Close other programs, or use --photos.max-side {max(smaller, 400)}"
        )
    return max(min(cores, 1 + int((available - needed) / (SIFT_BYTES * largest))), 1)


def available_bytes(groups: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> int:
    """Memory that this process may still use, in bytes: of the machine, and of its control groups under Linux.

    Batch systems and containers limit a job by its group (version 2), whose files lie in `groups` at the path that
    `own` names; cached files do not count.
    """
    free = psutil.virtual_memory().available
    try:
        folder = groups / own.read_text(encoding="utf-8").split("0::/", 1)[1].strip()
    except (OSError, IndexError):
        return free
    while folder.is_relative_to(groups):
        try:
            limit = int((folder / "memory.max").read_text(encoding="utf-8"))
            used = int((folder / "memory.current").read_text(encoding="utf-8"))
            shares = (folder / "memory.stat").read_text(encoding="utf-8").split()
            free = min(free, limit - used + int(shares[shares.index("inactive_file") + 1]))
        except (OSError, ValueError):  # no limit here ("max"), or none given
            pass
        folder = folder.parent
    return max(free, 0)


def require_memory(
    gaussians: int, config: Config, cameras: Sequence[Camera], *, trained: bool, free: int | None = None
) -> None:
    """Refuse a run that does not fit, before it starts.

    gaussians: most that there will be; free: usable bytes; `available_bytes` if not given.

    Raises:
        ConfigError: a stage needs more; names it and what would fit.
    """
    available = available_bytes() if free is None else free
    needed, stage = max(
        (size, stage) for stage, size in stage_bytes(gaussians, config, cameras, trained=trained).items()
    )
    if needed <= available:
        return
    fixed = stage_bytes(0, config, cameras, trained=trained)[stage]
    fitting = int((available - fixed) / (needed - fixed) * gaussians) // 1000 * 1000
    largest = max(cameras, key=lambda camera: camera.width * camera.height)
    advice = f"--train.max-gaussians {fitting}" if trained and fitting >= 1000 else "--scene.downscale 2 or more"
    raise ConfigError(
        f"{stage.capitalize()} with up to {gaussians:,} Gaussians and {len(cameras)} photos of up to {largest.width}×"
        f"{largest.height} needs about {needed / 2**30:.1f} GB of memory and {available / 2**30:.1f} GB are free. "
        f"Close other programs, or use {advice}"
    )
