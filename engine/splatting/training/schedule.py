"""What changes from step to step of a training, as a function of the step alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ...config import PRESETS, TrainConfig
from ...scene.camera import Camera, Scene
from ..rendering.render import FAINTEST, DrawRules
from .densify import DensifyRules
from .parameters import Rates

DENSIFY_GRADIENT = 4e-4
"""Mean absolute gradient of a projected position, in half-images, above which a Gaussian is cloned or split."""
PRUNE_OPACITY = 0.005
"""Densification removes Gaussians with a lower opacity."""
USUAL_PHOTOS, USUAL_PIXELS, MOST_GROWTH = 60, 480 * 360, 4.0
"""Photos that the presets are meant for: their number, and the pixels of each; and the largest factor for others."""
LEAST_OVERSIZE, OVERSIZE_GAUSSIANS = 0.1, 700
"""The largest Gaussian, as a share of the extent or of its distance: 3DGS's tenth, and more with fewer than 70,000
Gaussians, since N of them cover the scene if their size is proportional to 1 / √N."""


@dataclass(frozen=True, eq=False)
class Schedule:
    """The settings of a training, spread over its steps."""

    config: TrainConfig
    scene: Scene

    @cached_property
    def extent(self) -> float:
        """Scene units: a little more than the radius of the cameras."""
        return self.scene.extent

    @cached_property
    def middle(self) -> Tensor:
        """(3,) of the cameras."""
        return torch.from_numpy(self.scene.middle).float()

    def done(self, step: int) -> float:
        """Share of the training that is over."""
        return step / self.config.steps

    def rates(self, step: int) -> Rates:
        """The rate of the means is relative to the scene extent and falls exponentially to a hundredth; a short
        training needs higher ones than 3DGS's 30,000 steps."""
        config = self.config
        return Rates(
            means=config.means_rate * self.extent * 0.01 ** self.done(step),
            log_scales=config.scales_rate,
            quats=config.quats_rate,
            opacity_logits=config.opacity_rate,
            sh=config.sh_rate,
            sh_rest=config.sh_rest_rate,
        )

    def rules(self, step: int) -> DrawRules:
        """How the view of the step is rendered: one more degree of harmonics with every sixth of the steps."""
        config = self.config
        return DrawRules(
            sh_degree=min(config.sh_degree, int(6 * self.done(step))),
            antialiased=config.antialiased,
            pair_alpha=config.pair_alpha * FAINTEST,
            literal_pairs=config.literal_pairs,
        )

    def shrink(self, step: int) -> int:
        """The divisor of the photo's size in this step: 2 in the coarse part of the training."""
        return 2 if self.done(step) < self.config.coarse_until else 1

    @cached_property
    def last_densified(self) -> int:
        """The last step with densification."""
        return int(self.config.densify_until * self.config.steps)

    def densifies(self, step: int) -> bool:
        config = self.config
        begun = config.densify_from * config.steps <= step <= self.last_densified
        return begun and step % config.densify_every == 0

    def records_gradients(self, step: int) -> bool:
        """Whether a densification by gradient is still to come."""
        return self.config.densify == "gradient" and step < self.last_densified

    def densifications_left(self, step: int) -> int:
        """Number of remaining densifications, that of this step included."""
        return (self.last_densified - step) // self.config.densify_every + 1

    def resets_opacity(self, step: int) -> bool:
        every = self.config.reset_opacity_every
        return every > 0 and step % every == 0 and step < self.last_densified

    def drops_unneeded(self, step: int) -> bool:
        """Once, when densification has ended."""
        return self.config.drop_unneeded > 0 and step == min(self.last_densified + 1, self.config.steps)

    def forgives(self, step: int) -> bool:
        """Whether the worst pixels are left out: not before the scene is roughly trained."""
        return self.config.forgive > 0 and self.done(step) >= 0.5

    def checks(self, step: int) -> bool:
        every = self.config.check_every
        return every > 0 and step % every == 0 and step < self.config.steps

    def is_settled(self, step: int) -> bool:
        """Whether quality can decide about stopping: before, it jumps when photos get their full size and Gaussians are
        added."""
        return self.shrink(step) == 1 and step > self.last_densified

    def densify_rules(self) -> DensifyRules:
        return DensifyRules(
            gradient=DENSIFY_GRADIENT,
            max_gaussians=self.config.max_gaussians,
            small=self.config.split_size * self.extent,
            opacity=PRUNE_OPACITY,
            oversize=max(LEAST_OVERSIZE, math.sqrt(OVERSIZE_GAUSSIANS / self.config.max_gaussians)),
            extent=self.extent,
        )


def view_at(step: int, views: Sequence[int], seed: int) -> int:
    """The photo of a step: every round uses all photos once, in a random order from (seed, round)."""
    lap, place = divmod(step, len(views))
    return views[np.random.default_rng([seed, lap]).permutation(len(views))[place]]


def grow_settings(config: TrainConfig, cameras: Sequence[Camera], photos: int = 0) -> TrainConfig:
    """Return the settings with as many steps and Gaussians as the photos of the cameras need, if `grow` says so: both
    grow with the square root of the number of `photos`, Gaussians also with that of the pixels of a photo. Numbers that
    are not those of a preset stay."""
    if not config.grow or not cameras:
        return config
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    more, larger = max(photos / USUAL_PHOTOS, 1.0), max(pixels / USUAL_PIXELS, 1.0)
    steps, gaussians = (min(share**0.5, MOST_GROWTH) for share in (more, more * larger))
    presets = [PRESETS["quick"], PRESETS["standard"]]
    if config.steps in [preset.steps for preset in presets]:
        config = replace(config, steps=round(steps * config.steps))
    if config.max_gaussians in [preset.max_gaussians for preset in presets]:
        config = replace(config, max_gaussians=round(gaussians * config.max_gaussians))
    return config
