"""Densification: clone and split Gaussians with large image gradients, prune useless ones (3DGS, section 5.2)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...compiled.jit import threads
from ..gaussians import Gaussians
from ..kernels.densify import count_views
from .parameters import Parameters

SPLIT_SHRINK = 1.6
"""Both halves of a split Gaussian are smaller by this factor."""


@dataclass(frozen=True, kw_only=True)
class DensifyRules:
    """Bounds of one densification.

    gradient: mean length of the image gradient, in half-images, above which a Gaussian is cloned or split;
    max_gaussians: never more than this many; small: clone up to this size (scene units), split above; opacity: prune
    below; oversize: prune when the largest standard deviation exceeds this share of `extent` (scene units), or of the
    distance to the middle of the cameras where that is larger.
    """

    gradient: float
    max_gaussians: int
    small: float
    opacity: float
    oversize: float
    extent: float


@dataclass(eq=False)
class GradientStats:
    """Image gradients at each Gaussian since the last densification.

    sums: (N,) lengths of the gradients of the projected means in half-images; counts: (N,) views that rendered it.
    """

    sums: Tensor
    counts: Tensor

    @staticmethod
    def none(n: int) -> GradientStats:
        return GradientStats(torch.zeros(n), torch.zeros(n))

    def add(self, gradients: NDArray[np.float32], drawn: NDArray[np.int32], width: int, height: int) -> None:
        """Count one view. gradients: (N, 2) per pixel; drawn: (N,) not 0 if the view rendered the Gaussian."""
        halves = np.float32(0.5 * width), np.float32(0.5 * height)
        count_views(threads(), gradients, drawn, *halves, self.sums.numpy(), self.counts.numpy())

    @property
    def means(self) -> Tensor:
        return self.sums / self.counts.clamp_min(1.0)


def densify(
    parameters: Parameters, mean_gradients: GradientStats, rules: DensifyRules, middle: Tensor, seed: list[int]
) -> None:
    """Prune, then clone and split the Gaussians with the largest gradients while there is room. Moments stay with their
    Gaussians.

    middle: (3,) of the cameras; seed: of the positions of split halves.
    """
    keep = ~find_useless(parameters.gaussians(), rules, middle)
    if not keep.any():
        return
    gradient = mean_gradients.means[keep]
    parameters.select(keep)
    chosen = _select_strongest(gradient, rules.gradient, rules.max_gaussians - len(parameters))
    gaussians = parameters.gaussians()
    split = torch.zeros(len(parameters), dtype=torch.bool)
    split[chosen] = gaussians.log_scales[chosen].amax(1) > math.log(rules.small)
    cloned = gaussians.select(chosen[~split[chosen]])
    halves = _split(gaussians.select(split), np.random.default_rng(seed))
    parameters.append(cloned, chosen[~split[chosen]])
    parameters.append(halves, split.nonzero()[:, 0].repeat(2))
    parameters.select(torch.cat([~split, torch.ones(len(parameters) - len(split), dtype=torch.bool)]))


def _select_strongest(gradient: Tensor, threshold: float, room: int) -> Tensor:
    """Select the indices of the largest gradients above the threshold, at most `room` (each adds one Gaussian)."""
    order = gradient.argsort(descending=True, stable=True)
    return order[: max(min(int((gradient > threshold).sum()), room), 0)].sort().values


def _split(gaussians: Gaussians, random: np.random.Generator) -> Gaussians:
    """Split each into two smaller Gaussians, at positions sampled from it."""
    n = len(gaussians)
    drawn = torch.from_numpy(random.standard_normal((2, n, 3))).float()
    offsets = (gaussians.rotations @ (gaussians.scales * drawn)[..., None])[..., 0]
    return Gaussians(
        means=(gaussians.means + offsets).reshape(-1, 3),
        log_scales=(gaussians.log_scales - math.log(SPLIT_SHRINK)).repeat(2, 1),
        quats=gaussians.quats.repeat(2, 1),
        opacity_logits=gaussians.opacity_logits.repeat(2),
        sh=gaussians.sh.repeat(2, 1, 1),
    )


def find_useless(gaussians: Gaussians, rules: DensifyRules, middle: Tensor) -> Tensor:
    """Mark the Gaussians (N,) that are too faint to matter, too large for their position, or not finite."""
    distances = (gaussians.means - middle).norm(dim=1)
    sizes = gaussians.log_scales.amax(1)
    faint = gaussians.opacities < rules.opacity
    large = sizes.exp() > rules.oversize * distances.clamp_min(rules.extent)
    broken = ~(torch.isfinite(gaussians.means).all(1) & torch.isfinite(sizes))
    return faint | large | broken


def reset_opacity(parameters: Parameters, highest: float) -> None:
    """Lower every opacity to at most `highest`, so that only Gaussians that the photos need recover."""
    parameters.values["opacity_logits"].clamp_(max=math.log(highest / (1.0 - highest)))
    parameters.forget("opacity_logits")


def clamp_sizes(parameters: Parameters, middle: Tensor, extent: float) -> None:
    """Limit the standard deviations of every Gaussian to its distance from `middle`, or to `extent` if it is nearer.

    A Gaussian of the sky may be as large as it is far away. A larger one surrounds the cameras and appears as fog in
    photos that training did not use.
    """
    distances = (parameters.values["means"] - middle).norm(dim=1)
    torch.minimum(
        parameters.values["log_scales"],
        distances.clamp_min(extent).log()[:, None],
        out=parameters.values["log_scales"],
    )
