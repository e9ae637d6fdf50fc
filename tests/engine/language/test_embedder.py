"""Crop encoders counted end to end, with random weights: what is kept, reused and refused, not what is recognised."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ball_scene
import numpy as np
import pytest
from checkpoints import DIMENSION, write_clip

from fruitlangs.benchmarks.counting.simulated import Setting, simulate
from fruitlangs.engine.config import Config, CountConfig, EmbedConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.language.encoders.encoder import sees_fruit
from fruitlangs.engine.language.encoders.seen import map_size, scales_of
from fruitlangs.engine.language.features.embedder import Embedder
from fruitlangs.engine.language.features.features import gaussians_id, load_features
from fruitlangs.engine.language.features.photo_features import PhotoFeaturesRecorder
from fruitlangs.engine.pipeline import Result, count_scene
from fruitlangs.engine.scene.read import read_scene


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_scene.write_scene(tmp_path_factory.mktemp("embedder") / "balls", views=6)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Config:
    clip = str(write_clip(tmp_path_factory.mktemp("embedder") / "clip"))
    return Config(
        train=TrainConfig(steps=30, max_gaussians=2000),
        embed=EmbedConfig(encoder="clip", clip=clip, code_epochs=1),
        count=CountConfig(diameter=0.2, sample_budget=2000),
    )


@pytest.fixture(scope="module")
def lifted(scene: Path, config: Config, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return count_scene(scene, ["Durian fruit"], tmp_path_factory.mktemp("lifted"), config=config)


def test_masks_are_lifted_at_three_levels_and_any_word_is_counted(lifted: Result) -> None:
    features = load_features(lifted.out / "features.safetensors")
    assert features.vectors.shape == (len(lifted.gaussians), 3, DIMENSION)
    assert features.gaussians == gaussians_id(lifted.gaussians.means)
    assert not features.decoders
    assert lifted.fruit_count.count == len(lifted.fruit_count.fruits)
    assert {fruit.label for fruit in lifted.fruit_count.fruits} <= {"durian fruit"}


def test_another_word_reuses_gaussians_and_features_and_leave_to_download_changes_nothing(
    lifted: Result, scene: Path, config: Config
) -> None:
    allowed = replace(config, embed=replace(config.embed, allow_download=True))
    again = count_scene(scene, ["leaf"], lifted.out, config=allowed)
    assert again.reused == ["train", "embed"]
    asked = count_scene(lifted.out, ["leaf"], lifted.out.with_name("asked"), config=allowed)
    assert asked.fruit_count.count == again.fruit_count.count


def test_codes_are_trained_along_kept_with_their_decoder_and_leave_the_colours_alone(
    lifted: Result, scene: Path, config: Config, tmp_path: Path
) -> None:
    joint = replace(config, embed=replace(config.embed, features="joint"))
    first = count_scene(scene, ["apple"], tmp_path, config=joint)
    features = load_features(tmp_path / "features.safetensors")
    assert features.vectors.shape == (len(first.gaussians), 3, 3)
    assert features.gaussians == gaussians_id(first.gaussians.means)
    assert features.unit(0).shape == (len(first.gaussians), DIMENSION)
    np.testing.assert_array_equal(first.gaussians.means, lifted.gaussians.means)
    assert count_scene(scene, ["pear"], tmp_path, config=joint).reused == ["train", "embed"]


@pytest.mark.parametrize("scales", [[(1.5,), (0.75, 0.375)], []])
def test_an_encoder_of_whole_photos_sees_each_at_the_scales_that_are_given_if_any(
    scene: Path, tmp_path: Path, scales: list[tuple[float, ...]]
) -> None:
    whole = read_scene(scene)
    two = replace(whole, cameras=whole.cameras[:2], images=whole.images[:2])
    embedder, gaussians = (
        Embedder.open(EmbedConfig()),
        simulate(Setting(fruits=(2, 2), leaves=20, views=2), 1).gaussians,
    )
    assert sees_fruit(embedder.encoder)
    recorder = PhotoFeaturesRecorder(embedder.encoder.kinds(), embedder.encoder.fruit_identity)
    embedder.lift(gaussians, two, tmp_path, scales=scales, recorder=recorder)
    kept = recorder.collect()
    assert kept.seen_at == (scales or [(), ()])
    height, width = two.cameras[0].height, two.cameras[0].width
    assert kept.shapes[0].tolist() == list(map_size(height, width, scales[0] if scales else scales_of(height, width)))


def test_codes_of_an_encoder_without_masks_are_refused() -> None:
    with pytest.raises(ConfigError, match="--encoder clip"):
        Embedder.open(EmbedConfig(features="joint"))


def test_codes_cannot_be_trained_into_given_gaussians(lifted: Result, scene: Path, config: Config) -> None:
    joint = replace(config, embed=replace(config.embed, features="joint"))
    given = lifted.out / "gaussians.ply"
    with pytest.raises(ConfigError, match="--features lift"):
        count_scene(scene, ["apple"], lifted.out.with_name("given"), config=joint, imported=given)
