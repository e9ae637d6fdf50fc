"""Held-out PSNR over seconds of training."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

from ...engine.config import SceneConfig, TrainConfig
from ...engine.progress import Progress, silent
from ...engine.scene.read import read_scene
from ...engine.splatting.training.train import train

CHECKS = 20
"""Approximate number of measurements, at steps that training reports: every twentieth."""


@dataclass(frozen=True)
class Curve:
    """seconds: of training up to each measurement, without those of measuring; psnr: held-out, dB."""

    scene: str
    steps: int
    gaussians: int
    seconds: tuple[float, ...]
    psnr: tuple[float, ...]


def training_curve(
    scene_folder: Path,
    config: TrainConfig | None = None,
    *,
    scene_config: SceneConfig | None = None,
    progress: Progress = silent,
) -> Curve:
    """Train on a scene and measure on the way, after a short training that compiles."""
    config = config or TrainConfig()
    scene = read_scene(scene_folder, scene_config or SceneConfig())
    train(scene, replace(config, steps=3, densify_until=0.0))
    seconds: list[float] = []
    begun, away = time.perf_counter(), 0.0
    last_step = time.perf_counter()

    def watch(fraction: float, message: str) -> None:
        nonlocal away, last_step
        now = time.perf_counter()
        if "held-out PSNR" in message:  # the time since the last step was spent on measuring
            seconds.append(last_step - begun - away)
            away += now - last_step
        last_step = now
        progress(fraction, message)

    checked = replace(config, check_every=20 * max(round(config.steps / CHECKS / 20), 1))
    training = train(scene, checked, progress=watch)
    return Curve(
        scene=scene_folder.name,
        steps=training.steps,
        gaussians=len(training.gaussians),
        seconds=(*seconds, last_step - begun - away),
        psnr=(*(quality for _, quality in training.checks), training.psnr or 0.0),
    )
