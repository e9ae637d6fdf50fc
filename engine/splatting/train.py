"""Photos → Gaussians by gradient descent (Kerbl et al. 2023; paper section 3.1)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ..compiled import compiled_before
from ..config import TrainConfig
from ..errors import TrainingError
from ..progress import Progress, silent
from ..scene.camera import Scene
from .checkpoint import TrainingState, read_checkpoint, training_key, write_checkpoint
from .densify import DensifyRules, Pulls, densify, hold_sizes, reset_opacity
from .gaussians import Gaussians
from .initialise import camera_spread, first_gaussians
from .losses import photometric_loss, psnr, ssim
from .parameters import NAMES, Parameters, Rates
from .photos import PhotoShelf, Picture
from .rasterize import render


@dataclass(frozen=True)
class ViewScore:
    """How well a photo that training never saw is drawn: PSNR in dB, SSIM."""

    name: str
    psnr: float
    ssim: float


@dataclass(frozen=True, eq=False)
class Training:
    """Trained Gaussians and what is known of their quality.

    held_out: scores of the photos kept aside; psnr, ssim: their means, None where none was kept; steps: optimiser steps
    behind the Gaussians.
    """

    gaussians: Gaussians
    held_out: tuple[ViewScore, ...]
    psnr: float | None
    ssim: float | None
    steps: int


def train(
    scene: Scene, config: TrainConfig, *, checkpoint: Path | None = None, progress: Progress = silent
) -> Training:
    """Train Gaussians on a scene's photos.

    With `checkpoint`, the state is written there every `config.checkpoint_every` steps, and a call that finds it takes
    up from it: the result is the same, bit for bit, as without the interruption. A checkpoint that is damaged or of
    another scene is passed over, with a message to `progress`.

    Raises:
        TrainingError: there is nothing to train on, or the loss is no longer a number.
        SceneError: a photo cannot be read.
        OutputError: the checkpoint cannot be written.
        Cancelled: `progress` asked for it; the last checkpoint stays.
    """
    kept_aside = held_out_views(scene, config.holdout_every)
    views = [view for view in range(len(scene.cameras)) if view not in kept_aside]
    if not views:
        raise TrainingError("the scene has no photo to train on; give at least one")
    for view in sorted(kept_aside):
        progress(0.0, "reading the photos kept aside")
        PhotoShelf(scene, limit=0).picture(view)
    shelf = PhotoShelf(scene)
    key = training_key(scene, config)
    state = _resume(checkpoint, key, progress)
    if state is None:
        progress(0.0, "placing the first Gaussians")
        gaussians = first_gaussians(shelf, views, config.sh_degree, config.max_gaussians, config.seed)
        state = TrainingState(Parameters.start(gaussians), Pulls.none(len(gaussians)))
    if not compiled_before():
        progress(0.0, "compiling for this machine, about half a minute, the first time only")
    schedule = Schedule(config, scene)
    while state.step < config.steps:
        loss = _step(state, shelf, views, schedule)
        done = state.step
        if not math.isfinite(loss):
            raise _breakdown(done, f"the loss is {loss}")
        if done % 20 == 0 or done == config.steps:
            if not len(finite(state.parameters.gaussians())):
                raise _breakdown(done, "no Gaussian has finite values any more")
            progress(0.95 * done / config.steps, f"step {done}/{config.steps}, {len(state.parameters):,} Gaussians")
        if checkpoint is not None and done % config.checkpoint_every == 0 and done < config.steps:
            write_checkpoint(checkpoint, state, key)
    gaussians = finite(state.parameters.gaussians())
    progress(0.96, "measuring the photos kept aside")
    scores = tuple(_score(gaussians, shelf.picture(view), scene.images[view].name) for view in sorted(kept_aside))
    return Training(
        gaussians=gaussians,
        held_out=scores,
        psnr=float(np.mean([score.psnr for score in scores])) if scores else None,
        ssim=float(np.mean([score.ssim for score in scores])) if scores else None,
        steps=state.step,
    )


def finite(gaussians: Gaussians) -> Gaussians:
    """A copy without the Gaussians that hold NaN or infinity."""
    rows = [getattr(gaussians, name).reshape(len(gaussians), -1) for name in NAMES]
    return gaussians.select(torch.cat([torch.isfinite(row).all(1, keepdim=True) for row in rows], 1).all(1))


def _breakdown(step: int, reason: str) -> TrainingError:
    return TrainingError(
        f"training broke down at step {step}: {reason}; look for broken photos and wrong camera poses, or lower the"
        " learning rates"
    )


def held_out_views(scene: Scene, every: int) -> frozenset[int]:
    """Every n-th view from the first on (as 3DGS does); none for 0, and never all."""
    if every <= 1 or len(scene.cameras) < 2:
        return frozenset()
    return frozenset(range(0, len(scene.cameras), every))


@dataclass(frozen=True, eq=False)
class Schedule:
    """What changes from step to step, all of it a function of the step alone."""

    config: TrainConfig
    scene: Scene

    @cached_property
    def extent(self) -> float:
        return 1.1 * camera_spread(self.scene)

    @cached_property
    def middle(self) -> Tensor:
        return torch.from_numpy(np.stack([camera.center for camera in self.scene.cameras]).mean(0)).float()

    def done(self, step: int) -> float:
        return step / self.config.steps

    def rates(self, step: int) -> Rates:
        """That of the means is in the scene's extent and falls exponentially to a hundredth; a short training needs
        higher ones than 3DGS's 30,000 steps."""
        config = self.config
        return Rates(
            means=config.means_rate * self.extent * 0.01 ** self.done(step),
            log_scales=config.scales_rate,
            quats=config.quats_rate,
            opacity_logits=config.opacity_rate,
            sh=config.sh_rate,
            sh_rest=config.sh_rate / 20,
        )

    def sh_degree(self, step: int) -> int:
        """One degree more with every sixth of the steps."""
        return min(self.config.sh_degree, int(6 * self.done(step)))

    def densifies(self, step: int) -> bool:
        config = self.config
        begun = step >= config.densify_from * config.steps and step <= config.densify_until * config.steps
        return begun and step % config.densify_every == 0

    def resets_opacity(self, step: int) -> bool:
        every = self.config.reset_opacity_every
        return every > 0 and step % every == 0 and step <= self.config.densify_until * self.config.steps

    def rules(self) -> DensifyRules:
        return DensifyRules(
            gradient=self.config.densify_gradient,
            max_gaussians=self.config.max_gaussians,
            small=self.config.split_size * self.extent,
            opacity=self.config.prune_opacity,
            oversize=0.1,
            extent=self.extent,
        )


def view_at(step: int, views: Sequence[int], seed: int) -> int:
    """The photo of a step: every round shows all photos once, in an order drawn from (seed, round)."""
    lap, place = divmod(step, len(views))
    return views[np.random.default_rng([seed, lap]).permutation(len(views))[place]]


def _resume(checkpoint: Path | None, key: str, progress: Progress) -> TrainingState | None:
    if checkpoint is None or not checkpoint.exists():
        return None
    try:
        return read_checkpoint(checkpoint, key)
    except TrainingError as error:
        progress(0.0, f"starting anew: {error}")
        return None


def _step(state: TrainingState, shelf: PhotoShelf, views: Sequence[int], schedule: Schedule) -> float:
    """One photo: draw, compare, move; densify when it is time. Returns the photometric loss."""
    config, step = schedule.config, state.step
    picture = shelf.picture(view_at(step, views, config.seed))
    degree = schedule.sh_degree(step)
    gradients, pulled, radii, loss = _gradients(state.parameters.gaussians(), picture, config, degree)
    state.parameters.update(gradients, schedule.rates(step), degree)
    hold_sizes(state.parameters, schedule.middle, schedule.extent)
    state.pulls.add(pulled, radii, picture.camera.width, picture.camera.height)
    done = state.step
    if schedule.densifies(done):
        densify(state.parameters, state.pulls, schedule.rules(), schedule.middle, [config.seed, done])
        state.pulls = Pulls.none(len(state.parameters))
    if schedule.resets_opacity(done):
        reset_opacity(state.parameters, 0.05)
    return loss


def _gradients(
    gaussians: Gaussians, picture: Picture, config: TrainConfig, sh_degree: int
) -> tuple[dict[str, Tensor], Tensor, Tensor, float]:
    """Gradients by parameter, absolute ones of the projected means, the radii, and the loss."""
    leaves = {name: getattr(gaussians, name).detach().requires_grad_() for name in NAMES}
    pulls = torch.zeros(len(gaussians), 2)
    rendering = render(Gaussians(**leaves), picture.camera, sh_degree=sh_degree, screen_pulls=pulls)
    loss = photometric_loss(rendering.color, picture.pixels, ssim_weight=config.ssim_weight, mask=picture.mask)
    loss.backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    assert len(gradients) == len(NAMES)
    return gradients, pulls, rendering.radii, loss.item()


def _score(gaussians: Gaussians, picture: Picture, name: str) -> ViewScore:
    with torch.no_grad():
        color = render(gaussians, picture.camera).color
    return ViewScore(
        name=name,
        psnr=psnr(color, picture.pixels, mask=picture.mask),
        ssim=ssim(color, picture.pixels, mask=picture.mask),
    )
