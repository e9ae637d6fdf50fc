from __future__ import annotations

import dataclasses
import json
import re

import pytest

from fruitlangs.engine.config import REMOVED, STAGES, Config, CountConfig, PhotosConfig, SceneConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.setting import level_of
from fruitlangs.engine.storage.keys import stage_key


def test_a_config_survives_its_document() -> None:
    config = Config(scene=SceneConfig(downscale=2.0, up=(0.0, 0.6, -0.8)), count=CountConfig(threshold=0.3))
    assert Config.from_document(json.loads(json.dumps(dataclasses.asdict(config)))) == config


def test_a_document_of_another_version_is_an_error() -> None:
    document = dataclasses.asdict(Config())
    document["train"]["no_such_setting"] = 1
    with pytest.raises(ConfigError, match="another version"):
        Config.from_document(document)


def test_a_document_with_settings_that_were_removed_is_read_if_they_had_their_defaults() -> None:
    document = dataclasses.asdict(Config())
    for stage, settings in REMOVED.items():
        document[stage] |= settings
    assert Config.from_document(document) == Config()
    document["train"]["ssim_weight"] = 0.5
    with pytest.raises(ConfigError, match=r"made with --train\.ssim-weight 0\.5, a removed setting"):
        Config.from_document(document)


def test_ten_settings_or_fewer_are_common() -> None:
    levels = [level_of(field) for stage in STAGES.values() for field in dataclasses.fields(stage)]
    assert 0 < levels.count("common") <= 10
    assert levels.count("experimental") > 0


@pytest.mark.parametrize(
    ("stage", "setting", "value"),
    [
        (SceneConfig, "downscale", 0.5),
        (TrainConfig, "steps", 0),
        (TrainConfig, "sh_degree", 4),
        (CountConfig, "threshold", 1.0),
        (CountConfig, "diameter", -0.08),
        (CountConfig, "diameter", 0.0),
        (CountConfig, "diameter", float("inf")),
        (CountConfig, "diameter", float("nan")),
        (SceneConfig, "downscale", float("inf")),
        (SceneConfig, "up", (0.0, 0.0, 0.0)),
        (SceneConfig, "up", (0.0, float("nan"), 1.0)),
        (SceneConfig, "up", (0.0, 1.0)),
        (TrainConfig, "checkpoint_every", 0),
        (TrainConfig, "densify_every", 0),
        (TrainConfig, "seed", -1),
        (TrainConfig, "densify", "gradients"),
        (CountConfig, "method", "votng"),
        (TrainConfig, "steps", 400.5),
        (CountConfig, "trees", True),
        (CountConfig, "threshold", "0.4"),
        (PhotosConfig, "upright", "ture"),
        (TrainConfig, "device", 7),
    ],
)
def test_a_senseless_setting_is_an_error_that_names_it(stage: type, setting: str, value: object) -> None:
    stage_name = stage.__name__.removesuffix("Config").lower()
    with pytest.raises(ConfigError, match=re.escape(f"--{stage_name}.{setting.replace('_', '-')} is {value}. Use ")):
        stage(**{setting: value})


@pytest.mark.parametrize("stage", [SceneConfig, TrainConfig, CountConfig])
def test_every_number_has_a_range_that_leaves_out_nan_and_what_is_negative(stage: type) -> None:
    numbers = [setting for setting in dataclasses.fields(stage) if not isinstance(setting.default, str | bool)]
    for setting in numbers:
        for value in (float("nan"), float("inf"), -1):
            with pytest.raises(ConfigError, match=setting.name.replace("_", "-")):
                stage(**{setting.name: value})


def test_a_stage_key_follows_its_settings() -> None:
    assert stage_key(("scene",), "hash", TrainConfig()) == stage_key(("scene",), "hash", TrainConfig())
    assert stage_key(("scene",), "hash", TrainConfig()) != stage_key(("scene",), "hash", TrainConfig(seed=1))
    assert stage_key(("scene",), "hash", TrainConfig()) != stage_key(("report",), "hash", TrainConfig())
