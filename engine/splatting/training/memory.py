"""The memory that a training needs, and whether it is available."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import psutil

from ...errors import TrainingError
from ...scene.camera import Camera
from ..kernels.project_backward import MOMENT
from ..kernels.records import RECORD
from .losses import REMEMBERED
from .photos import KEPT

TILES_EACH = 6
"""Mean number of tiles per Gaussian and view: 3 to 5 were measured."""
STEP_PLANES = 40
"""float32 planes of a photo's size that a step keeps: blending, gradients, the loss's scratch."""
BASE = 400 << 20
"""Bytes of the program itself, its libraries and the machine code."""


def training_bytes(gaussians: int, sh_degree: int, cameras: Sequence[Camera]) -> int:
    """Approximate peak memory of training, in bytes."""
    values = 11 + 3 * (sh_degree + 1) ** 2
    # Values, two moments, gradients, and a second copy of the first three while Gaussians are added.
    a_gaussian = 4 * (7 * values + RECORD + 8) + TILES_EACH * (4 * MOMENT + 12)
    pixels = [camera.width * camera.height for camera in cameras]
    both_sizes = 1.25 * sum(pixels)  # full and half size
    photos = min(int(4 * both_sizes), KEPT)  # with masks
    moments = min(int(24 * both_sizes), REMEMBERED)
    return BASE + gaussians * a_gaussian + photos + moments + 4 * STEP_PLANES * max(pixels, default=0)


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


def require_memory(gaussians: int, sh_degree: int, cameras: Sequence[Camera], free: int | None = None) -> None:
    """Refuse a training that does not fit.

    free: usable bytes; `available_bytes` if not given.

    Raises:
        TrainingError: it needs more; says what would fit.
    """
    available = available_bytes() if free is None else free
    needed = training_bytes(gaussians, sh_degree, cameras)
    if needed <= available:
        return
    fixed = training_bytes(0, sh_degree, cameras)
    each = (needed - fixed) / gaussians
    fitting = int((available - fixed) / each) // 1000 * 1000
    advice = f"--train.max-gaussians {fitting}" if fitting >= 1000 else "--scene.downscale 2 or more"
    raise TrainingError(
        f"Training up to {gaussians:,} Gaussians on photos of up to {max(c.width for c in cameras)}×"
        f"{max(c.height for c in cameras)} needs about {needed / 2**30:.1f} GB of memory and {available / 2**30:.1f} GB"
        f" are free. Close other programs, or use {advice}"
    )
