"""A whole count on a graphics card, with the card in the provenance."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import ball_scene
import numpy as np
from conftest import balls_config

from fruitlangs.engine.pipeline import count_scene
from fruitlangs.engine.splatting.gpu.adapters import Adapter


def test_a_count_on_a_card_finds_the_fruit(balls: Path, adapter: Adapter, tmp_path: Path) -> None:
    usual = balls_config()
    config = dataclasses.replace(usual, train=dataclasses.replace(usual.train, steps=80, device=adapter.name))
    result = count_scene(balls, ["apple"], tmp_path / "out", config=config)
    assert result.origin["training"]["device"] == adapter.identity
    assert not any("CPU" in notice for notice in result.notices)
    away = np.linalg.norm(result.fruit_count.centers[:, None] - ball_scene.BALLS, axis=2)
    assert result.fruit_count.count == len(ball_scene.BALLS)
    assert away.min(axis=1).max() < 0.25 * ball_scene.DIAMETERS.mean()
    again = count_scene(balls, ["apple"], tmp_path / "out", config=config)
    assert again.reused == ["train", "embed"]
