from __future__ import annotations

import dataclasses

import pytest

from fruitlangs.engine.cache import stage_key
from fruitlangs.engine.config import Config, CountConfig, SceneConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError


def test_a_config_survives_its_document() -> None:
    config = Config(scene=SceneConfig(downscale=2.0), count=CountConfig(threshold=0.3))
    assert Config.from_document(dataclasses.asdict(config)) == config


def test_a_document_of_another_version_is_an_error() -> None:
    document = dataclasses.asdict(Config())
    document["train"]["no_such_setting"] = 1
    with pytest.raises(ConfigError, match="another version"):
        Config.from_document(document)


@pytest.mark.parametrize(
    ("stage", "setting", "value"),
    [
        (SceneConfig, "downscale", 0.5),
        (TrainConfig, "steps", 0),
        (TrainConfig, "sh_degree", 4),
        (CountConfig, "threshold", 1.0),
        (CountConfig, "diameter", -0.08),
    ],
)
def test_a_senseless_setting_is_an_error_that_names_it(stage: type, setting: str, value: float) -> None:
    with pytest.raises(ConfigError, match=setting.replace("_", "-")):
        stage(**{setting: value})


def test_a_stage_key_follows_its_settings() -> None:
    assert stage_key(("scene",), "hash", TrainConfig()) == stage_key(("scene",), "hash", TrainConfig())
    assert stage_key(("scene",), "hash", TrainConfig()) != stage_key(("scene",), "hash", TrainConfig(seed=1))
    assert stage_key(("scene",), "hash", TrainConfig()) != stage_key(("report",), "hash", TrainConfig())
