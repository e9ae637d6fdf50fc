"""Calibration for lifted features: on Gaussians of rendered scenes with true masks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...engine.config import PRESETS, Preset, SceneConfig
from ...engine.evaluation.calibration import balance_weights
from ...engine.evaluation.renders import read_instances
from ...engine.language.encoders.embedded import Calibration, EmbeddedEncoder
from ...engine.language.encoders.encoder import Question
from ...engine.language.features.lift import encode_photos, lift_features
from ...engine.language.prompts.relevancy import MIN_WEIGHT, margin
from ...engine.photo_size import photo_scales
from ...engine.scene.camera import Scene
from ...engine.scene.read import read_scene
from ...engine.splatting.gaussians import Gaussians
from ...engine.splatting.ply import read_ply, write_ply
from ...engine.splatting.training.train import train
from .calibration import Fit, logistic
from .pictures import LEAST_WALK
from .reliability import judge_probabilities

FloatArray = NDArray[np.float64]

SHARPEST = 0.4
"""Lowest temperature: rendered scenes are easier than real ones and must not make the encoder overconfident."""

KEPT = "gaussians.ply"
"""File in the folder of a rendered tree with Gaussians of all its photos."""

FRUIT_SHARE = 0.15
"""Share of fruit, by pixels, that lifted features are calibrated for: the value with the best counts on rendered trees
and on the sample."""


@dataclass(frozen=True, eq=False)
class LiftedScene:
    """One scene's Gaussians: margin of "fruit" (N,), whether most of their pixels are fruit (N,), weights (N,)."""

    margins: FloatArray
    fruit: NDArray[np.bool_]
    weights: FloatArray

    @property
    def is_informative(self) -> bool:
        """Whether it has fruit and other objects: without both it cannot be used for calibration."""
        return bool(self.fruit.any() and not self.fruit.all())


@dataclass(frozen=True)
class LiftedMeasures:
    """Means over rendered trees of the calibration error of "fruit" (see `reliability`) and of
    `intersection_over_union`."""

    scenes: int
    calibration_error: float
    iou: float


def find_finished_scenes(folder: Path) -> list[Path]:
    """Find every finished scene below `folder`."""
    return [path.parent for path in sorted(folder.glob("*/truth.json"))]


def find_rendered_scenes(folder: Path) -> list[Path]:
    """Find every finished scene below `folder` with enough pictures to train Gaussians."""
    return [scene for scene in find_finished_scenes(folder) if len(list((scene / "images").glob("*"))) >= LEAST_WALK]


def train_once(kept: Path, scene: Scene, preset: Preset = "standard") -> Gaussians:
    """Return the Gaussians of a rendered tree, trained once and kept in a file."""
    if not kept.is_file():
        write_ply(kept, train(scene, PRESETS[preset]).gaussians)
    return read_ply(kept)


def lift_scene(encoder: EmbeddedEncoder, folder: Path) -> LiftedScene:
    """Return one of the `find_rendered_scenes` with lifted features."""
    scene = read_scene(folder, SceneConfig())
    gaussians = train_once(folder / KEPT, scene)
    photos = encode_photos(scene, encoder, photo_scales(scene, encoder))
    features = lift_features(gaussians, scene.cameras, photos, encoder_id=encoder.identity)
    fruit = measure_true_fruit(folder, scene, gaussians)
    weights = features.weights[:, 0]
    seen = weights >= MIN_WEIGHT
    (question,) = encoder.questions("fruit")
    assert isinstance(question, Question)  # no word was taught
    return LiftedScene(
        margin(features.unit(0)[seen], question).double().numpy(),
        (fruit > 0.5)[seen].numpy(),
        weights[seen].double().numpy(),
    )


def measure_true_fruit(folder: Path, scene: Scene, gaussians: Gaussians) -> Tensor:
    """Measure the share (N,) of the pixels of each Gaussian that are fruit in the true masks."""
    truth = lift_features(gaussians, scene.cameras, _read_masks(folder, scene), encoder_id="truth").unit(0)
    return truth[:, 0] / truth.sum(dim=1).clamp_min(1e-9)


def _read_masks(folder: Path, scene: Scene) -> Iterator[Tensor]:
    for instances in read_instances(folder, scene):
        mask = torch.from_numpy(instances > 0).float()
        yield torch.stack([mask, 1.0 - mask], dim=-1)


def calibrate_lifted(scenes: Sequence[LiftedScene], pixels: Calibration) -> Fit:
    """Temperature and bias of "fruit" for lifted features; scenes have equal weight, and in each FRUIT_SHARE is fruit.

    All scenes are informative (see `LiftedScene`). A fiftieth of the pixels of a scene may be fruit; at that share a
    half-hidden fruit rarely has a probability above one half, and counting would miss it. At equal shares leaves become
    fruit.
    """
    m, t = (np.concatenate([getattr(scene, name) for scene in scenes]) for name in ("margins", "fruit"))
    shares = np.where(t, FRUIT_SHARE, 1.0 - FRUIT_SHARE)
    w = shares * np.concatenate([balance_weights(scene.fruit, scene.weights) for scene in scenes])
    temperature, bias = logistic(m, t, w)
    sharpest = max(temperature, SHARPEST)
    return Fit(Calibration(sharpest, bias * temperature / sharpest, pixels.kind_temperature), FRUIT_SHARE)


def measure_lifted(scenes: Sequence[LiftedScene], pixels: Calibration) -> LiftedMeasures | None:
    """Measure each scene with the calibration of all others; None for fewer than two. All scenes are informative (see
    `LiftedScene`)."""
    if len(scenes) < 2:
        return None
    errors, overlaps = [], []
    for place, one in enumerate(scenes):
        fit = calibrate_lifted([*scenes[:place], *scenes[place + 1 :]], pixels)
        calibration = fit.calibration
        guess = 1.0 / (1.0 + np.exp(calibration.bias - one.margins / calibration.temperature))
        found = judge_probabilities(guess, one.fruit, fit.prior, one.weights)
        assert found is not None  # it is informative
        errors.append(found.calibration_error)
        overlaps.append(intersection_over_union([one], calibration))
    return LiftedMeasures(len(errors), float(np.mean(errors)), float(np.mean(overlaps)))


def intersection_over_union(scenes: Sequence[LiftedScene], calibration: Calibration) -> float:
    """Intersection over union of the Gaussians with P(fruit) ≥ 0.5 and the true ones, weighted by drawn pixels."""
    both = either = 0.0
    for scene in scenes:
        chosen = scene.margins / calibration.temperature >= calibration.bias
        both += float(scene.weights[chosen & scene.fruit].sum())
        either += float(scene.weights[chosen | scene.fruit].sum())
    return both / max(either, 1e-9)
