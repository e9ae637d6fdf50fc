"""One step of training: render the view of a photo, compare, and update the Gaussians in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from ...config import TrainConfig
from ..kernels.tile import CHANNELS as PLANES
from ..rendering.render import blend_view, load_view, project_view, tile_view, view_backward
from ..rendering.workspace import Workspace
from .checkpoint import TrainingState
from .densify import GradientStats, clamp_sizes, densify, reset_opacity
from .extra_channels import ExtraChannels
from .losses import PhotometricLoss, unevenness
from .parameters import CHANNELS, Parameters
from .photos import Picture
from .relocate import inject_noise, relocate
from .schedule import Schedule

SSIM_WEIGHT = 0.2
"""Weight of 1 - SSIM in the photometric loss; L1 has the rest (3DGS)."""
HOLD_EVERY = 10
"""Steps between two limits of the size of Gaussians: they grow slowly."""
PATCH = 15
"""Side in pixels of the windows that are ignored together: as wide as a leaf, so that fine texture is kept."""
_BLACK = np.zeros(3, np.float32)


class Stepper(Protocol):
    """What takes the steps of a training: the CPU, or a graphics card."""

    look_every: int
    """Steps between two looks at the Gaussians, to see whether training broke down."""

    def take(self, state: TrainingState, picture: Picture) -> float:
        """Render, compare, update; densify and prune when due. Returns the last loss that is known.

        Raises:
            GpuError: the graphics card failed; `state` is as it was when it was last collected.
        """
        ...

    def collect(self, state: TrainingState) -> None:
        """Bring `state` up to the last step.

        Raises:
            GpuError: as `take`.
        """
        ...


class Step:
    """Takes steps on the CPU; holds what steps share: reused memory, and the loss's cache of photos."""

    look_every = 20

    def __init__(self, schedule: Schedule, extra: ExtraChannels | None = None) -> None:
        self.schedule = schedule
        self.extra = extra
        self.workspace = Workspace()
        self.loss = PhotometricLoss(SSIM_WEIGHT, self.workspace)

    def take(self, state: TrainingState, picture: Picture) -> float:
        """As `Stepper`; the loss is that of the picture and of further channels."""
        schedule, config, step = self.schedule, self.schedule.config, state.step
        drawn, parameter_gradients, loss = self.gradients(state, picture, step)
        regularise(parameter_gradients, state.parameters, config, schedule.extent)
        rates = replace(schedule.rates(step), channels=self._channel_rate(step))
        state.parameters.update(parameter_gradients, rates, schedule.rules(step).sh_degree, drawn)
        if config.densify == "mcmc":
            inject_noise(state.parameters, schedule.extent, schedule.done(step), [config.seed, step, 0])
        elif schedule.records_gradients(step):
            state.mean_gradients.add(
                parameter_gradients["mean_gradients"], drawn, picture.camera.width, picture.camera.height
            )
        if step % HOLD_EVERY == 0:
            clamp_sizes(state.parameters, schedule.middle, schedule.extent)
        densify_and_prune(state, schedule)
        return loss

    def collect(self, state: TrainingState) -> None:
        """As `Stepper`: nothing is elsewhere."""

    def gradients(
        self, state: TrainingState, picture: Picture, step: int
    ) -> tuple[NDArray[np.int32], dict[str, NDArray[Any]], float]:
        """Which Gaussians the view rendered (N,), the gradients by parameter, and the loss."""
        workspace, rules, camera = self.workspace, self.schedule.rules(step), picture.camera
        if state.poses is not None:
            camera = state.poses.camera(picture.view, camera)
        parameters = state.parameters.arrays()
        extra = self.extra if self._channel_rate(step) > 0 else None
        features = np.zeros((len(state.parameters), 0), np.float32) if extra is None else state.parameters.channels()
        tiles = tile_view(project_view(parameters, camera, rules, workspace), camera, rules, workspace)
        planes = blend_view(tiles, features, camera, workspace)
        gradients = workspace.zeros("gradients", (5 + features.shape[1], camera.height, camera.width))
        image = planes[:3]
        if state.exposures is not None:
            image = state.exposures.apply(picture.view, image, workspace)
        mask = picture.mask
        if self.schedule.forgives(step):
            mask = select_inliers(image, picture, self.schedule.config.forgive)
        loss = self.loss.backward(image, picture.pixels, mask, gradients[:3], key=(picture.view, camera.width))
        if state.exposures is not None:
            state.exposures.learn(picture.view, planes[:3], gradients[:3], self.schedule.done(step), workspace)
        if extra is not None:
            loss += extra.loss(picture.view, planes[PLANES:], gradients[5:])
        load_gradient = None
        share = self.schedule.config.load_weight
        if share > 0:
            _, load_gradient = unevenness(load_view(tiles, planes, workspace)[1])
            load_gradient *= share / (1.0 - share)  # of (1 - λ) · photometric + λ · unevenness, over 1 - λ
        parameter_gradients = view_backward(
            parameters, camera, rules, tiles, planes, gradients, workspace,
            features=features, background=_BLACK, load_gradient=load_gradient,
            with_depth=False, with_mean_gradients=self.schedule.records_gradients(step),
            features_push=extra is not None and extra.moves_gaussians,
        )  # fmt: skip
        if extra is not None:
            parameter_gradients[CHANNELS] = parameter_gradients["features"]
        if state.poses is not None:
            state.poses.learn(picture.view, parameter_gradients["pose"], self.schedule.done(step), self.schedule.extent)
        return tiles.counts, parameter_gradients, loss

    def _channel_rate(self, step: int) -> float:
        return 0.0 if self.extra is None else self.extra.rate_at(self.schedule.done(step))


def changes_number(schedule: Schedule, done: int) -> bool:
    """Whether `densify_and_prune` does anything after this many steps."""
    return schedule.densifies(done) or schedule.resets_opacity(done)


def densify_and_prune(state: TrainingState, schedule: Schedule) -> None:
    """What is due after a step, besides the step itself."""
    config, done = schedule.config, state.step
    if schedule.densifies(done):
        if config.densify == "mcmc":
            relocate(
                state.parameters,
                config.max_gaussians,
                schedule.densifications_left(done),
                [config.seed, done, 1],
            )
        else:
            densify(
                state.parameters, state.mean_gradients, schedule.densify_rules(), schedule.middle, [config.seed, done]
            )
        state.mean_gradients = GradientStats.none(len(state.parameters))
    if schedule.resets_opacity(done):
        reset_opacity(state.parameters, 0.05)


def select_inliers(image: NDArray[np.float32], picture: Picture, share: float) -> NDArray[np.bool_]:
    """Select the pixels (H, W) to learn from: all usable ones except the `share` that differ most, in patches
    (RobustNeRF, Sabour et al. 2023): what moves between photos rarely matches twice."""
    away = np.abs(image - picture.pixels.transpose(2, 0, 1) * np.float32(1 / 255)).mean(0)
    smooth = uniform_filter(away, PATCH, mode="nearest")
    use = np.ones(smooth.shape, bool) if picture.mask is None else picture.mask
    if not use.any():
        return use
    return use & (smooth <= np.quantile(smooth[use], 1.0 - share))


def regularise(gradients: dict[str, NDArray[Any]], parameters: Parameters, config: TrainConfig, extent: float) -> None:
    """Add the gradients of the paper's λ_reg terms: means over Gaussians of opacity, of size and of thickness, both in
    scene extents (3DGS-MCMC; PhysGaussian)."""
    n = max(len(parameters), 1)
    gaussians = parameters.gaussians()
    d_opacity_logits = torch.from_numpy(
        gradients["opacity_logits"]
    )  # rows of Gaussians that were not rendered contain arbitrary values
    d_log_scales = torch.from_numpy(gradients["log_scales"])
    if config.opacity_weight > 0:
        opacities = gaussians.opacities
        d_opacity_logits += opacities * (1 - opacities) * (config.opacity_weight / n)
    if config.scale_weight > 0:
        d_log_scales += gaussians.scales * (config.scale_weight / (3 * n * extent))
    if config.flatness_weight > 0:
        thinnest = gaussians.log_scales.argmin(1, keepdim=True)
        slope = gaussians.scales.gather(1, thinnest) * (config.flatness_weight / (n * extent))
        d_log_scales.scatter_add_(1, thinnest, slope)
