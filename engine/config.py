"""The settings of every stage: declared once, shown as flags, as Blender properties and in the docs.

Field docstrings (the string below a field) are the text of the flag and of the tooltip.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from .errors import ConfigError


def _require(condition: bool, message: str) -> None:
    if not condition:
        raise ConfigError(message)


@dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """How photos and cameras are read."""

    downscale: float = 1.0
    """Divide the photos' width and height by this (2 = half size)."""

    def __post_init__(self) -> None:
        _require(self.downscale >= 1.0, f"downscale is {self.downscale}; use 1 or more (2 halves width and height)")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """How Gaussians are trained from the photos."""

    steps: int = 3000
    """Optimiser steps, one photo each."""
    max_gaussians: int = 100_000
    """Densification stops at this many Gaussians."""
    sh_degree: int = 2
    """Highest degree of the spherical harmonics that carry view-dependent colour (0-3)."""
    holdout_every: int = 8
    """Keep every n-th photo (in name order) out of training to measure quality; 0 trains on all."""
    ssim_weight: float = 0.2
    """Weight of 1 - SSIM in the photometric loss; L1 has the rest."""
    means_rate: float = 5e-4
    """Learning rate of positions at the start, times the scene's extent; it falls to a hundredth."""
    scales_rate: float = 2e-2
    """Learning rate of log scales."""
    quats_rate: float = 1e-2
    """Learning rate of rotations."""
    opacity_rate: float = 0.1
    """Learning rate of opacity logits."""
    sh_rate: float = 5e-3
    """Learning rate of base colours; harmonics above move at a twentieth of it."""
    final_rates: float = 1.0
    """What all learning rates but that of positions fall to by the last step, as a share."""
    coarse_until: float = 0.0
    """Share of the steps that train on photos of half size."""
    densify_from: float = 0.05
    """Share of the steps after which Gaussians are cloned and split."""
    densify_until: float = 0.6
    """Share of the steps after which no Gaussian is added any more."""
    densify_every: int = 100
    """Steps between two densifications."""
    densify_gradient: float = 4e-4
    """Mean absolute gradient of a projected position, in half-images, from which a Gaussian is cloned or split."""
    split_size: float = 0.003
    """Gaussians whose standard deviation exceeds this share of the scene's extent are split, others cloned."""
    prune_opacity: float = 0.005
    """Gaussians fainter than this are removed when densifying."""
    reset_opacity_every: int = 0
    """Steps between two resets of all opacities, which clear floaters in long trainings; 0 for never."""
    opacity_weight: float = 0.0
    """Weight of the mean opacity in the loss: what no photo needs fades."""
    scale_weight: float = 0.0
    """Weight of the mean size (in extents of the scene) in the loss."""
    flatness_weight: float = 0.0
    """Weight of the mean shortest axis (in extents of the scene) in the loss: Gaussians become discs on surfaces."""
    random_background: bool = False
    """Draw each step over another colour, so that surfaces become opaque."""
    checkpoint_every: int = 500
    """Steps between two checkpoints."""
    seed: int = 0
    """Seed of every random choice in training."""

    def __post_init__(self) -> None:
        _require(self.steps >= 1, f"steps is {self.steps}; use at least 1")
        _require(self.max_gaussians >= 1, f"max-gaussians is {self.max_gaussians}; use at least 1")
        _require(0 <= self.sh_degree <= 3, f"sh-degree is {self.sh_degree}; use 0, 1, 2 or 3")
        _require(self.holdout_every >= 0, f"holdout-every is {self.holdout_every}; use 0 (none) or more")
        _require(0.0 <= self.ssim_weight <= 1.0, f"ssim-weight is {self.ssim_weight}; use 0 to 1")


@dataclass(frozen=True, kw_only=True)
class EmbedConfig:
    """How Gaussians get features that words can query."""

    encoder: Literal["embedded"] = "embedded"
    """Image and text encoder; 'embedded' ships with the package and needs no download."""


@dataclass(frozen=True, kw_only=True)
class CountConfig:
    """How fruit are selected and counted."""

    threshold: float = 0.5
    """Lowest probability at which a Gaussian belongs to the prompt."""
    method: Literal["voting", "template"] = "voting"
    """'voting': centre votes, sphere fits, non-maximum suppression; 'template': the paper's DBSCAN and templates."""
    diameter: float | None = None
    """Mean fruit diameter in scene units; estimated from the scene when not given."""
    sample_budget: int = 60_000
    """Points sampled from the selected Gaussians."""
    seed: int = 0
    """Seed of every random choice in counting."""

    def __post_init__(self) -> None:
        _require(0.0 < self.threshold < 1.0, f"threshold is {self.threshold}; use a probability between 0 and 1")
        _require(
            self.diameter is None or self.diameter > 0.0,
            f"diameter is {self.diameter}; use a length above 0 scene units",
        )
        _require(self.sample_budget >= 100, f"sample-budget is {self.sample_budget}; use at least 100 points")


@dataclass(frozen=True, kw_only=True)
class Config:
    """Every stage's settings: what a run needs beside its scene and its prompt."""

    scene: SceneConfig = field(default_factory=SceneConfig)
    """Photos and cameras."""
    train: TrainConfig = field(default_factory=TrainConfig)
    """Gaussians."""
    embed: EmbedConfig = field(default_factory=EmbedConfig)
    """Features and words."""
    count: CountConfig = field(default_factory=CountConfig)
    """Fruit."""

    @classmethod
    def from_document(cls, document: Mapping[str, Any]) -> Config:
        """The config that `dataclasses.asdict` turned into `document`.

        Raises:
            ConfigError: it was written by another version with other settings.
        """
        stages = {"scene": SceneConfig, "train": TrainConfig, "embed": EmbedConfig, "count": CountConfig}
        try:
            return cls(**{name: stage(**document[name]) for name, stage in stages.items()})
        except (KeyError, TypeError) as error:
            raise ConfigError(
                f"stored settings are of another version ({error}); count again from the photos"
            ) from error
