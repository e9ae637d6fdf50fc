"""A whole count on a graphics card, with the card in the provenance."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import ball_scene
import numpy as np
from conftest import balls_config

from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.pipeline import count_scene
from fruitlangs.engine.splatting.gpu.adapters import Adapter


def test_a_count_on_a_card_finds_the_fruit(balls: Path, adapter: Adapter, tmp_path: Path) -> None:
    usual = balls_config()
    train = dataclasses.replace(usual.train, steps=60, max_gaussians=800, coarse_until=0.0, device=adapter.name)
    config = dataclasses.replace(usual, train=train, scene=SceneConfig(downscale=1.2))
    result = count_scene(balls, ["apple"], tmp_path / "out", config=config)
    assert result.origin["training"]["device"] == adapter.identity
    assert not any("CPU" in notice for notice in result.notices)
    away = np.linalg.norm(result.fruit_count.centers[:, None] - ball_scene.BALLS, axis=2)
    assert result.fruit_count.count >= 3
    assert away.min(axis=1).max() < 0.5 * ball_scene.DIAMETERS.mean()
