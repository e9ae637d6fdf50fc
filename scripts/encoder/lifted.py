"""Calibration where it is used: on Gaussians that many views drew, in rendered scenes with true masks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from sklearn.linear_model import LogisticRegression
from torch import Tensor

from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.language.embedded import Calibration, EmbeddedEncoder
from fruitlangs.engine.language.lift import encode_photos, lift_features
from fruitlangs.engine.language.relevancy import MIN_WEIGHT, margin
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.ply import read_ply

FloatArray = NDArray[np.float64]

SHARPEST = 0.4
"""Lowest temperature: rendered scenes are easier than real ones, and must not make the encoder too sure of itself."""


@dataclass(frozen=True, eq=False)
class LiftedScene:
    """One scene's Gaussians: margin of "fruit" (N,), whether most of their pixels are fruit (N,), weights (N,)."""

    margins: FloatArray
    fruit: NDArray[np.bool_]
    weights: FloatArray


def walks(folder: Path) -> list[Path]:
    """Every scene below `folder`: a walk around a tree with instances/ and the gaussians.ply trained from it.

    Raises:
        FormatError: there is none.
    """
    found = [path.parent for path in sorted(folder.glob("*/gaussians.ply"))]
    if not found:
        raise FormatError(f"{folder} has no scene with a gaussians.ply; count its scenes with count_fruit.py first")
    return found


def lifted_scene(encoder: EmbeddedEncoder, folder: Path) -> LiftedScene:
    """One of the `walks`, seen by the encoder."""
    scene, gaussians = read_scene(folder, SceneConfig()), read_ply(folder / "gaussians.ply")
    features = lift_features(gaussians, scene.cameras, encode_photos(scene, encoder), encoder_id=encoder.identity)
    truth = lift_features(gaussians, scene.cameras, _masks(folder, scene), encoder_id="truth").unit(0)
    weights = features.weights[:, 0]
    seen = weights >= MIN_WEIGHT
    (question,) = encoder.questions("fruit")
    return LiftedScene(
        margin(features.unit(0)[seen], question).double().numpy(),
        (truth[:, 0] > truth[:, 1])[seen].numpy(),
        weights[seen].double().numpy(),
    )


def _masks(folder: Path, scene: Scene) -> Iterator[Tensor]:
    for photo in scene.images:
        mask = torch.from_numpy(np.array(Image.open(folder / "instances" / f"{Path(photo.name).stem}.png")) > 0).float()
        yield torch.stack([mask, 1.0 - mask], dim=-1)


def calibrate_lifted(scenes: Sequence[LiftedScene], pixels: Calibration) -> Calibration:
    """Temperature and bias of "fruit" for lifted features; each scene and, in it, each drawn pixel counts alike."""
    m, t = (np.concatenate([getattr(scene, name) for scene in scenes]) for name in ("margins", "fruit"))
    w = np.concatenate([scene.weights / scene.weights.sum() for scene in scenes])
    fit = LogisticRegression(C=1e6, max_iter=200).fit(np.clip(m, -12, 12)[:, None], t, sample_weight=w * len(w))
    slope, middle = float(fit.coef_[0, 0]), float(-fit.intercept_[0] / fit.coef_[0, 0])
    temperature = max(1.0 / slope, SHARPEST)
    return Calibration(temperature, middle / temperature, pixels.kind_temperature)


def intersection_over_union(scenes: Sequence[LiftedScene], calibration: Calibration) -> float:
    """Of the Gaussians with P(fruit) ≥ 0.5 and the true ones, by drawn pixels."""
    both = either = 0.0
    for scene in scenes:
        chosen = scene.margins / calibration.temperature >= calibration.bias
        both += float(scene.weights[chosen & scene.fruit].sum())
        either += float(scene.weights[chosen | scene.fruit].sum())
    return both / max(either, 1e-9)
