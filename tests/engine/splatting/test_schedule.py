"""How long, and with how many Gaussians, photos are trained."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.config import PRESETS, TrainConfig
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.training.schedule import grow_settings


def cameras(width: int, height: int, number: int = 1) -> list[Camera]:
    return [Camera(np.eye(3), np.eye(4), width, height)] * number


@pytest.mark.parametrize(("photos", "size"), [(60, (480, 360)), (20, (300, 225))])
def test_usual_and_smaller_photos_are_trained_as_the_preset_says(photos: int, size: tuple[int, int]) -> None:
    assert grow_settings(TrainConfig(), cameras(*size), photos) == TrainConfig()


def test_photos_of_four_times_the_pixels_get_twice_the_gaussians_and_as_many_steps() -> None:
    config = grow_settings(TrainConfig(), cameras(960, 720), 60)
    assert (config.steps, config.max_gaussians) == (1200, 140_000)


def test_four_times_the_photos_get_twice_the_steps_and_gaussians() -> None:
    config = grow_settings(TrainConfig(), cameras(480, 360), 240)
    assert (config.steps, config.max_gaussians) == (2400, 140_000)


def test_the_pixels_of_mixed_photos_are_their_mean() -> None:
    mixed = cameras(480, 360) + cameras(480, 7 * 360)
    assert grow_settings(TrainConfig(), mixed).max_gaussians == 140_000


def test_growth_has_an_end() -> None:
    config = grow_settings(TrainConfig(), cameras(48_000, 36_000), 60_000)
    assert (config.steps, config.max_gaussians) == (4800, 280_000)


def test_the_quick_preset_grows_and_the_papers_does_not() -> None:
    assert grow_settings(PRESETS["quick"], cameras(960, 720), 240).steps == 800
    assert grow_settings(PRESETS["paper"], cameras(960, 720), 240) == PRESETS["paper"]


def test_numbers_that_a_user_chose_stay() -> None:
    config = grow_settings(TrainConfig(steps=1000, max_gaussians=50_000), cameras(960, 720), 240)
    assert (config.steps, config.max_gaussians) == (1000, 50_000)


def test_growth_can_be_switched_off() -> None:
    assert grow_settings(TrainConfig(grow=False), cameras(960, 720), 240) == TrainConfig(grow=False)
