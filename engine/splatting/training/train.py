"""Photos → Gaussians by gradient descent (Kerbl et al. 2023; paper section 3.1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...compiled.jit import is_all_compiled
from ...config import TrainConfig
from ...errors import GpuError, TrainingError
from ...progress import Progress, silent
from ...scene.camera import Camera, Scene
from ..gaussians import PARAMETERS, Gaussians
from ..gpu.adapters import Adapter
from ..rendering.rasterize import accumulate
from .card_step import CardStep
from .checkpoint import TrainingState, read_checkpoint, training_key, write_checkpoint
from .densify import GradientStats
from .exposure import Exposures
from .extra_channels import ExtraChannels
from .initialise import initialise_gaussians
from .parameters import Parameters
from .photos import PhotoShelf, Picture
from .poses import Poses
from .schedule import Schedule, view_at
from .scores import ViewScore, score_view
from .step import Step, Stepper

CPU = "CPU"
"""The name of the CPU as a device."""


@dataclass(frozen=True, eq=False)
class Training:
    """Trained Gaussians and their quality.

    held_out: scores of held-out photos; steps: number of optimiser steps; checks: (step, held-out PSNR in dB) during
    training; cameras: of the scene, at their refined poses; channels: (N, C) the further channels, C = 0 without any;
    device: what took the steps.
    """

    gaussians: Gaussians
    held_out: tuple[ViewScore, ...]
    steps: int
    checks: tuple[tuple[int, float], ...]
    cameras: tuple[Camera, ...]
    channels: Tensor
    device: str = CPU

    @property
    def psnr(self) -> float | None:
        """Mean over held-out photos, in dB; None without any."""
        return self.mean_score("psnr")

    @property
    def ssim(self) -> float | None:
        """Mean over held-out photos; None without any."""
        return self.mean_score("ssim")

    def mean_score(self, name: str) -> float | None:
        """Mean of one number of `ViewScore` over held-out photos; None without any."""
        return float(np.mean([getattr(score, name) for score in self.held_out])) if self.held_out else None


Watch = Callable[[Gaussians, Scene], None]
"""Receives the Gaussians trained so far, in the frame of the scene, and the scene; the call must be short."""
WATCH_EVERY = 100
"""Steps between two calls of a `Watch`."""

LEAST_GAIN = 0.02
"""Gain of held-out PSNR in dB below which a measurement counts as no progress."""


def train(
    scene: Scene,
    config: TrainConfig,
    *,
    checkpoint: Path | None = None,
    extra: ExtraChannels | None = None,
    adapter: Adapter | None = None,
    watch: Watch | None = None,
    progress: Progress = silent,
) -> Training:
    """Train Gaussians on the photos of a scene, and with `extra` further channels.

    adapter: the graphics card that takes the steps (see `adapter_for`), None for the CPU. If the card fails, the CPU
    goes on from the last sound state.

    With `checkpoint`, the state is written there every `config.checkpoint_every` steps, and a call that finds it
    resumes: the result is the same, bit for bit, as without the interruption. A checkpoint that is damaged or belongs
    to another scene is ignored, with a message to `progress`. `watch` receives copies of the Gaussians.

    Raises:
        TrainingError: there is nothing to train on, settings contradict each other, memory does not suffice, or the
            loss is no longer a number.
        SceneError: a photo cannot be read.
        OutputError: the checkpoint cannot be written.
        Cancelled: `progress` asked for it; the last checkpoint stays.
    """
    held_out = choose_held_out(scene, config.holdout_every)
    views = [view for view in range(len(scene.cameras)) if view not in held_out]
    if not views:
        raise TrainingError("The scene has no photo to train on. Give at least one")
    middle = scene.middle
    require_digits(middle, scene.extent)
    measured = _find_usable(PhotoShelf(scene, limit=0), sorted(held_out), progress)
    if config.patience > 0 and (config.check_every == 0 or not measured):
        raise TrainingError(
            "--train.patience needs measurements of held-out photos: give --train.check-every, and a"
            " --train.holdout-every that keeps some"
        )
    device = "" if adapter is None else adapter.identity
    key = training_key(scene, config, ("" if extra is None else extra.key) + device)
    near = _shift_scene(scene, -middle)  # float32 has too few digits for a small scene far from the origin
    shelf = PhotoShelf(near)
    try:
        shown = None if watch is None else lambda gaussians: watch(_shift_gaussians(gaussians, middle), scene)
        photos = _Photos(shelf, views, measured)
        training = _train(near, config, photos, _Saved(checkpoint, key), extra, adapter, shown, progress)
    finally:
        shelf.close()
    cameras = (
        _shift_scene(replace(scene, cameras=training.cameras), middle).cameras if config.refine_poses else scene.cameras
    )
    return replace(training, gaussians=_shift_gaussians(training.gaussians, middle), cameras=tuple(cameras))


def _shift_gaussians(gaussians: Gaussians, offset: NDArray[np.float64]) -> Gaussians:
    """Move the Gaussians by an offset (3,)."""
    return replace(gaussians, means=(gaussians.means.double() + torch.from_numpy(offset)).float())


COARSEST = 1e-3
"""Largest acceptable step of single precision, in scene extents."""


def require_digits(middle: NDArray[np.float64], extent: float) -> None:
    """Refuse a scene so far from its origin that Gaussians would lie on a coarse grid.

    Raises:
        TrainingError: it does; says how far away it is.
    """
    away = float(np.abs(middle).max())
    step = float(np.spacing(np.float32(away)))
    if not step <= COARSEST * extent:
        raise TrainingError(
            f"The scene lies {away:.6g} units from its origin, where single precision has steps of {step:.2g} units,"
            f" too coarse for a scene of {extent:.2g}. Move the model to the middle of its cameras"
        )


def _shift_scene(scene: Scene, offset: NDArray[np.float64]) -> Scene:
    """Move the scene with everything in it by an offset (3,)."""
    cameras = []
    for camera in scene.cameras:
        pose = camera.world_to_camera.copy()
        pose[:3, 3] = -pose[:3, :3] @ (camera.center + offset)
        cameras.append(replace(camera, world_to_camera=pose))
    return replace(scene, cameras=cameras, points=np.asarray(scene.points, np.float64) + offset)


@dataclass(frozen=True, eq=False)
class _Photos:
    """The cached photos, and which views are trained on and which are held out for measurement."""

    shelf: PhotoShelf
    trained: Sequence[int]
    held_out: Sequence[int]


@dataclass(frozen=True)
class _Saved:
    """Where checkpoints are written, None for nowhere, and the key that they must have."""

    file: Path | None
    key: str


def _train(
    scene: Scene,
    config: TrainConfig,
    photos: _Photos,
    saved: _Saved,
    extra: ExtraChannels | None,
    adapter: Adapter | None,
    watch: Callable[[Gaussians], None] | None,
    progress: Progress,
) -> Training:
    shelf, views = photos.shelf, photos.trained
    channels = 0 if extra is None else extra.count
    state = _resume(saved, progress) or _start(shelf, views, config, channels, progress)
    if not is_all_compiled():
        progress(0.0, "Compiling for this computer, about 15 s (first run only)")
    schedule = Schedule(config, scene)
    stepper, device = _make_stepper(schedule, extra, adapter, progress)
    blank = 0
    while state.step < config.steps:
        picture = _picture(shelf, state.step, views, schedule)
        blank = blank + 1 if picture.mask is not None and not picture.mask.any() else 0
        if blank == 2 * len(views) - 1:  # includes a whole round, whatever its order
            raise TrainingError("The masks leave no pixel of any photo to learn from. White is what may be used")
        try:
            loss = stepper.take(state, picture)
            done = state.step
            if _needs_gaussians(done, stepper.look_every, schedule, saved, config, watch is not None):
                stepper.collect(state)
        except GpuError as error:
            device = f"{CPU} from step {state.step} on: {error}"
            progress(0.95 * state.step / config.steps, f"{error}. The CPU goes on from step {state.step}")
            stepper = Step(schedule, extra)
            continue
        if not math.isfinite(loss):
            raise _breakdown(done, f"the loss is {loss}")
        if schedule.drops_unneeded(done):
            state.select(_find_needed(state, config, [_pose_camera(state, scene, view) for view in views]))
        if done % 20 == 0 or done == config.steps:
            if done % stepper.look_every == 0 and not find_finite(state.parameters.gaussians()).any():
                raise _breakdown(done, "no Gaussian has finite values any more")
            progress(0.95 * done / config.steps, f"step {done}/{config.steps}, {len(state.parameters):,} Gaussians")
        if watch is not None and done % WATCH_EVERY == 0:
            so_far = _select_drawable(state, config)
            watch(so_far.select(find_finite(so_far)))
        if schedule.checks(done) and photos.held_out:
            scores = _scores(_select_drawable(state, config), shelf, photos.held_out, config)
            quality = float(np.mean([score.psnr for score in scores]))
            state.checks.append((done, quality))
            progress(0.95 * done / config.steps, f"step {done}: held-out PSNR {quality:.2f} dB")
            if is_stalled([checked for at, checked in state.checks if schedule.is_settled(at)], config.patience):
                break
        if saved.file is not None and done % config.checkpoint_every == 0 and done < config.steps:
            write_checkpoint(saved.file, state, saved.key)
    trained = _select_drawable(state, config)
    whole = find_finite(trained)
    gaussians = trained.select(whole)
    progress(0.96, "Measuring the held-out photos")
    held_out = _scores(gaussians, shelf, photos.held_out, config)
    return Training(
        gaussians=gaussians,
        held_out=held_out,
        steps=state.step,
        checks=tuple(state.checks),
        cameras=tuple(_pose_camera(state, scene, view) for view in range(len(scene.cameras))),
        channels=torch.from_numpy(state.parameters.channels())[whole],
        device=device,
    )


def _make_stepper(
    schedule: Schedule, extra: ExtraChannels | None, adapter: Adapter | None, progress: Progress
) -> tuple[Stepper, str]:
    """Make what takes the steps, and its name for the provenance."""
    if adapter is None:
        return Step(schedule, extra), CPU
    try:
        return CardStep(schedule, adapter), adapter.identity
    except GpuError as error:
        progress(0.0, f"{error}. The CPU trains")
        return Step(schedule, extra), f"{CPU}: {error}"


def _needs_gaussians(
    done: int, every: int, schedule: Schedule, saved: _Saved, config: TrainConfig, watched: bool
) -> bool:
    """Whether something besides the next step needs the Gaussians after this many steps."""
    return (
        done % every == 0
        or done == config.steps
        or schedule.drops_unneeded(done)
        or schedule.checks(done)
        or (watched and done % WATCH_EVERY == 0)
        or (saved.file is not None and done % config.checkpoint_every == 0)
    )


def _pose_camera(state: TrainingState, scene: Scene, view: int) -> Camera:
    """Return a view's camera at its current pose."""
    return scene.cameras[view] if state.poses is None else state.poses.camera(view, scene.cameras[view])


def _find_usable(shelf: PhotoShelf, views: Sequence[int], progress: Progress) -> list[int]:
    """Find the views whose photos have a usable pixel; all are read, so that a broken one is reported at once."""
    usable = []
    for view in views:
        progress(0.0, "Reading the held-out photos")
        mask = shelf.picture(view).mask
        if mask is None or mask.any():
            usable.append(view)
    return usable


def _start(
    shelf: PhotoShelf, views: Sequence[int], config: TrainConfig, channels: int, progress: Progress
) -> TrainingState:
    progress(0.0, "placing the first Gaussians")
    gaussians = initialise_gaussians(shelf, views, config.sh_degree, config.max_gaussians, config.seed)
    exposures = Exposures.neutral(len(shelf.scene.cameras)) if config.exposure else None
    poses = Poses.of(shelf.scene.cameras) if config.refine_poses else None
    return TrainingState(Parameters.start(gaussians, channels), GradientStats.none(len(gaussians)), exposures, poses)


def _picture(shelf: PhotoShelf, step: int, views: Sequence[int], schedule: Schedule) -> Picture:
    """The photo of the step; the next one is decoded in the background."""
    picture = shelf.picture(view_at(step, views, schedule.config.seed), schedule.shrink(step))
    if step + 1 < schedule.config.steps:
        shelf.expect(view_at(step + 1, views, schedule.config.seed), schedule.shrink(step + 1))
    return picture


def is_stalled(checks: Sequence[float], patience: int) -> bool:
    """Whether the last `patience` measurements (dB) gained nothing over earlier ones."""
    if patience == 0 or len(checks) <= patience:
        return False
    return max(checks[-patience:]) < max(checks[:-patience]) + LEAST_GAIN


def find_finite(gaussians: Gaussians) -> Tensor:
    """Mark the Gaussians (N,) without NaN or infinity."""
    rows = [getattr(gaussians, name).reshape(len(gaussians), -1) for name in PARAMETERS]
    return torch.cat([torch.isfinite(row).all(1, keepdim=True) for row in rows], 1).all(1)


def _breakdown(step: int, reason: str) -> TrainingError:
    return TrainingError(
        f"Training broke down at step {step}: {reason}. Look for broken photos and wrong camera poses, or lower the"
        " learning rates"
    )


def choose_held_out(scene: Scene, every: int) -> frozenset[int]:
    """Choose every n-th view, starting with the first (as in 3DGS); none for 0, and never all."""
    if every <= 1 or len(scene.cameras) < 2:
        return frozenset()
    return frozenset(range(0, len(scene.cameras), every))


def _resume(saved: _Saved, progress: Progress) -> TrainingState | None:
    if saved.file is None or not saved.file.exists():
        return None
    try:
        return read_checkpoint(saved.file, saved.key)
    except TrainingError as error:
        progress(0.0, f"starting again: {error}")
        return None


def _select_drawable(state: TrainingState, config: TrainConfig) -> Gaussians:
    return replace(state.parameters.gaussians(), antialiased=config.antialiased)


def _find_needed(state: TrainingState, config: TrainConfig, cameras: Sequence[Camera]) -> Tensor:
    """Mark the Gaussians (N,) to which some camera gives more than `drop_unneeded` pixels of blending weight."""
    gaussians = _select_drawable(state, config)
    most = torch.zeros(len(gaussians))
    for camera in cameras:
        weights = accumulate(gaussians, camera, torch.zeros(camera.height, camera.width, 0)).weights
        most = torch.maximum(most, weights)
    needed = most > config.drop_unneeded
    if not needed.any():
        raise TrainingError(
            f"--train.drop-unneeded {config.drop_unneeded:g} would remove every Gaussian: no photo shows one with more"
            f" than {float(most.max()):.1f} pixels' weight. Give less"
        )
    return needed


def _scores(
    gaussians: Gaussians, shelf: PhotoShelf, views: Sequence[int], config: TrainConfig
) -> tuple[ViewScore, ...]:
    names = [photo.name for photo in shelf.scene.images]
    return tuple(score_view(gaussians, shelf.picture(view), names[view], exposure=config.exposure) for view in views)
