"""Time of every stage of a training step, for ours and for a rasteriser in plain PyTorch, in one run."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

import numba
import numpy as np
import torch
from torch import Tensor

from ...engine.errors import ConfigError
from ...engine.progress import Progress, silent
from ...engine.scene.camera import Camera
from ...engine.splatting.gaussians import PARAMETERS, Gaussians
from ...engine.splatting.rendering.render import DrawRules, blend_view, project_view, tile_view, view_backward
from ...engine.splatting.rendering.workspace import Workspace
from ...engine.splatting.training.losses import PhotometricLoss
from ...engine.splatting.training.parameters import Parameters, Rates
from . import plain_rasterizer

P = ParamSpec("P")
T = TypeVar("T")
STAGES = ("project", "sort", "blend", "backward", "loss", "optimiser")
DRAWING = STAGES[:4]
FORWARD_AND_BACKWARD, STEP = "forward+backward", "step"
SH_DEGREE = 3
RATES = Rates(means=1e-6, log_scales=1e-6, quats=1e-6, opacity_logits=1e-6, sh=1e-6, sh_rest=1e-6)
"""Too small to affect the measurement."""
_config: Any = numba.config  # its attributes appear at run time
MOST_THREADS: int = _config.NUMBA_NUM_THREADS


@dataclass(frozen=True)
class Setting:
    """A configuration: Gaussians with harmonics of degree 3, the size of the image in pixels, threads."""

    gaussians: int
    width: int
    height: int
    threads: int


@dataclass(frozen=True)
class Row:
    """The median seconds of a stage, those of the baseline, and their ratio; None if it was not run."""

    stage: str
    gaussians: int
    width: int
    height: int
    threads: int
    seconds: float
    baseline: float | None
    baseline_ratio: float | None


def make_orchard_like(n: int, seed: int = 0) -> Gaussians:
    """Make n Gaussians, spread as in a trained orchard: a crown with flat leaves, the ground, and a far dome.

    Sizes fall with n^-½ in the crown, because more Gaussians share a surface; a trained sample has the same mean number
    of tiles per Gaussian.
    """
    random = np.random.default_rng([seed, n])
    crown, ground = int(0.75 * n), int(0.2 * n)
    dome = n - crown - ground
    directions = random.normal(size=(crown, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    leaves = directions * np.cbrt(random.random((crown, 1))) * [1.0, 1.1, 1.0]
    floor = np.column_stack([random.uniform(-4, 4, ground), np.full(ground, 1.4), random.uniform(-4, 4, ground)])
    floor[:, 1] += random.normal(0, 0.02, ground)
    far = random.normal(size=(dome, 3))
    far *= 20.0 / np.linalg.norm(far, axis=1, keepdims=True)
    scale = math.sqrt(50_000 / n)
    sizes = np.concatenate([np.full(crown, 0.012 * scale), np.full(ground, 0.05 * scale), np.full(dome, 0.9 * scale)])
    log_scales = np.log(sizes)[:, None] + random.normal(0, 0.5, (n, 3))
    log_scales[:, 2] -= 1.0
    sh = random.normal(0, 0.05, (n, (SH_DEGREE + 1) ** 2, 3))
    sh[:, 0] = random.normal(0, 0.7, (n, 3))
    return Gaussians(
        means=torch.from_numpy(np.concatenate([leaves, floor, far])).float(),
        log_scales=torch.from_numpy(log_scales).float(),
        quats=torch.from_numpy(random.normal(size=(n, 4))).float(),
        opacity_logits=torch.from_numpy(random.normal(0.0, 2.0, n)).float(),
        sh=torch.from_numpy(sh).float(),
    )


def look_ahead(width: int, height: int) -> Camera:
    """Return a camera 3 units from the crown, which fills most of the picture's height."""
    pose = np.eye(4)
    pose[2, 3] = 3.0
    focal = 1.1 * height
    return Camera(
        K=np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]),
        world_to_camera=pose,
        width=width,
        height=height,
    )


def measure(
    settings: Sequence[Setting], *, repeats: int = 7, baseline_memory: float = 8e9, progress: Progress = silent
) -> list[Row]:
    """Rows of all stages, and of forward+backward and the whole step, for every setting.

    The baseline runs once to warm up and then twice; if its tables would need more than `baseline_memory` bytes, it is
    left out.

    Raises:
        ConfigError: a setting asks for more threads than there are.
    """
    rows = []
    for k, setting in enumerate(settings):
        progress(k / len(settings), f"{setting.gaussians:,} Gaussians at {setting.width}×{setting.height}")
        with _use_threads(setting.threads):
            ours, theirs = _time_ours(setting, repeats), _time_baseline(setting, baseline_memory)
        for stage in (*STAGES, FORWARD_AND_BACKWARD, STEP):
            baseline = None if theirs is None else theirs[stage]
            ratio = None if baseline is None else baseline / ours[stage]
            rows.append(
                Row(
                    stage,
                    setting.gaussians,
                    setting.width,
                    setting.height,
                    setting.threads,
                    ours[stage],
                    baseline,
                    ratio,
                )
            )
    return rows


@contextmanager
def _use_threads(n: int) -> Iterator[None]:
    """Run with n threads.

    Raises:
        ConfigError: the machine has fewer.
    """
    if n > MOST_THREADS:
        raise ConfigError(f"--threads {n} is more than the {MOST_THREADS} of this machine. Give fewer")
    before = numba.get_num_threads(), torch.get_num_threads()
    numba.set_num_threads(n)
    torch.set_num_threads(n)
    try:
        yield
    finally:
        numba.set_num_threads(before[0])
        torch.set_num_threads(before[1])


class _Watch:
    """Seconds by stage, one list entry per repeat."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = {stage: [] for stage in STAGES}

    def time(self, stage: str, call: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        begun = time.perf_counter()
        result = call(*arguments, **named)
        self.seconds[stage].append(time.perf_counter() - begun)
        return result

    def medians(self) -> dict[str, float]:
        """{stage, or sum of stages: median seconds}."""
        runs = {stage: np.array(seconds[1:] or seconds) for stage, seconds in self.seconds.items()}
        found = {stage: statistics.median(seconds) for stage, seconds in runs.items()}
        found[FORWARD_AND_BACKWARD] = float(np.median(sum(runs[stage] for stage in DRAWING)))
        found[STEP] = float(np.median(sum(runs[stage] for stage in STAGES)))
        return found


def _make_photo(setting: Setting) -> np.ndarray[Any, np.dtype[np.uint8]]:
    random = np.random.default_rng(1)
    return random.integers(0, 256, (setting.height, setting.width, 3), dtype=np.uint8)


def _time_ours(setting: Setting, repeats: int) -> dict[str, float]:
    parameters = Parameters.start(make_orchard_like(setting.gaussians))
    camera = look_ahead(setting.width, setting.height)
    rules, workspace, watch = DrawRules(sh_degree=SH_DEGREE), Workspace(), _Watch()
    features, background = np.zeros((setting.gaussians, 0), np.float32), np.zeros(3, np.float32)
    gradients = np.zeros((5, setting.height, setting.width), np.float32)
    loss = PhotometricLoss(0.2, workspace)
    photo = _make_photo(setting)
    for _ in range(repeats + 1):
        arrays = parameters.arrays()
        projection = watch.time("project", project_view, arrays, camera, rules, workspace)
        tiles = watch.time("sort", tile_view, projection, camera, rules, workspace)
        planes = watch.time("blend", blend_view, tiles, features, camera, workspace)
        watch.time("loss", loss.backward, planes[:3], photo, None, gradients[:3], key=0)
        parameter_gradients = watch.time(
            "backward", view_backward, arrays, camera, rules, tiles, planes, gradients, workspace,
            features=features, background=background, with_depth=False,
        )  # fmt: skip
        watch.time("optimiser", parameters.update, parameter_gradients, RATES, SH_DEGREE, tiles.counts)
    return watch.medians()


def _time_baseline(setting: Setting, memory: float) -> dict[str, float] | None:
    gaussians, camera = make_orchard_like(setting.gaussians), look_ahead(setting.width, setting.height)
    leaves: dict[str, Tensor] = {name: getattr(gaussians, name).requires_grad_() for name in PARAMETERS}
    view = plain_rasterizer.View.of(camera.K, camera.world_to_camera, camera.width, camera.height)
    photo = torch.from_numpy(_make_photo(setting)).float() / 255
    optimiser = torch.optim.Adam(leaves.values(), lr=1e-6, fused=True)
    watch = _Watch()
    for _ in range(3):
        optimiser.zero_grad()
        splats = watch.time("project", plain_rasterizer.project, leaves, view)
        gaussian, sizes = watch.time("sort", plain_rasterizer.tile_lists, splats, view.width, view.height)
        if plain_rasterizer.bytes_needed(len(gaussian)) > memory:
            return None
        color = watch.time("blend", plain_rasterizer.blend, splats, gaussian, sizes, view.width, view.height)
        held = color.detach().requires_grad_()
        watch.time("loss", _baseline_loss_backward, held, photo)
        watch.time("backward", color.backward, held.grad)
        watch.time("optimiser", optimiser.step)
        del splats, color, held
        gc.collect()
    return watch.medians()


def _baseline_loss_backward(color: Tensor, photo: Tensor) -> None:
    plain_rasterizer.loss(color, photo).backward()  # type: ignore[no-untyped-call]
