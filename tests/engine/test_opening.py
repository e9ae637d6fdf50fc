"""An earlier result opened again is what the count left in memory."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch

from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.errors import EncoderError, FormatError
from fruitlangs.engine.open_result import open_result
from fruitlangs.engine.pipeline import count_scene, reconstruct_scene


@pytest.fixture
def counted(counted_balls):
    return counted_balls


def test_an_opened_result_is_what_was_counted(counted):
    opened = open_result(counted.out)
    assert opened.set_id == counted.set_id
    assert opened.fruit_count.count == counted.fruit_count.count > 0
    assert opened.fruit_count.interval == counted.fruit_count.interval
    assert opened.fruit_count.total_interval == counted.fruit_count.total_interval
    assert opened.fruit_count.last_id == counted.fruit_count.last_id
    assert [entry.reason for entry in opened.fruit_count.audit] == [entry.reason for entry in counted.fruit_count.audit]
    torch.testing.assert_close(opened.probability, counted.probability, rtol=0, atol=0)
    for mine, its in zip(opened.fruit_count.fruits, counted.fruit_count.fruits, strict=True):
        assert (mine.id, mine.label, mine.kind, mine.views, mine.fallen) == (
            its.id, its.label, its.kind, its.views, its.fallen
        )  # fmt: skip
        np.testing.assert_allclose(mine.center, its.center, atol=1e-6)
        np.testing.assert_allclose(mine.axes, its.axes, atol=1e-6)
        assert mine.volume == pytest.approx(its.volume, rel=1e-5)
        np.testing.assert_array_equal(mine.color, its.color)
        np.testing.assert_array_equal(mine.members, its.members)


def test_lengths_of_an_opened_result_are_scene_units_whatever_its_scale(counted, tmp_path):
    units = dataclasses.replace(counted.config.units, metres_per_unit=0.25)
    scaled = count_scene(
        counted.out, ["apple"], tmp_path / "out", config=dataclasses.replace(counted.config, units=units)
    )
    opened = open_result(scaled.out)
    assert opened.scene.metres_per_unit == 0.25
    np.testing.assert_allclose(opened.fruit_count.diameters, counted.fruit_count.diameters, atol=1e-5)
    np.testing.assert_allclose(opened.fruit_count.centers, counted.fruit_count.centers, atol=1e-6)


@pytest.fixture
def without_encoder(monkeypatch):
    def missing(config):
        raise EncoderError("The checkpoint is not there")

    monkeypatch.setattr("fruitlangs.engine.open_result.Embedder.open", missing)


@pytest.fixture
def before_selections(counted, tmp_path):
    """The same result as a version wrote it that kept no selection."""
    folder = shutil.copytree(counted.out, tmp_path / "older", ignore=shutil.ignore_patterns("cache"))
    document = json.loads((folder / "fruits.json").read_text())
    del document["files"]["selection.safetensors"]
    (folder / "selection.safetensors").unlink()
    (folder / "fruits.json").write_text(json.dumps(document))
    return folder


def test_an_older_result_is_asked_again_and_finds_its_members_by_place(counted, before_selections):
    opened = open_result(before_selections)
    torch.testing.assert_close(opened.probability, counted.probability, rtol=0, atol=0)
    for mine, its in zip(opened.fruit_count.fruits, counted.fruit_count.fruits, strict=True):
        assert set(its.members) <= set(mine.members)  # members of a stored fruit are asked no probability


def test_a_result_is_shown_with_its_answer_where_its_encoder_is_missing(counted, without_encoder):
    opened = open_result(counted.out)
    torch.testing.assert_close(opened.probability, counted.probability, rtol=0, atol=0)
    assert list(opened.notices) == list(counted.notices)
    assert all("reproduced poorly" in notice for notice in counted.notices)


def test_an_opened_result_says_again_what_was_wrong_with_its_count(counted, tmp_path):
    folder = shutil.copytree(counted.out, tmp_path / "doubtful", ignore=shutil.ignore_patterns("cache"))
    document = json.loads((folder / "fruits.json").read_text())
    document |= {"notices": ["38 fruit of other kinds were found"], "other_fruit": 38}
    (folder / "fruits.json").write_text(json.dumps(document))
    opened = open_result(folder)
    assert opened.notices[0] == "38 fruit of other kinds were found"
    assert opened.fruit_count.other_fruit == 38


def test_an_older_result_whose_encoder_is_missing_is_still_shown(counted, before_selections, without_encoder):
    opened = open_result(before_selections)
    assert opened.fruit_count.count == counted.fruit_count.count
    assert float(opened.probability.max()) == 0.0
    assert any("The checkpoint is not there" in notice for notice in opened.notices)


def test_a_damaged_fruit_is_an_error_and_not_a_lower_count(counted, tmp_path):
    folder = shutil.copytree(counted.out, tmp_path / "copy")
    document = json.loads((folder / "fruits.json").read_text())
    del document["fruits"][0]["axes"]
    (folder / "fruits.json").write_text(json.dumps(document))
    with pytest.raises(FormatError, match=r"damaged.*Count again"):
        open_result(folder)


def test_a_count_finds_what_was_reconstructed_before_it(counted, balls, tmp_path):
    seen = []
    made, stages = reconstruct_scene(
        balls, tmp_path / "out", config=counted.config, watch=lambda *shown: seen.append(shown)
    )
    assert [len(gaussians) > 0 for gaussians, _ in seen] == [True]  # 150 steps, one look every hundred
    assert stages.reused == []
    result = count_scene(balls, ["apple"], tmp_path / "out", config=counted.config)
    assert result.reused == ["train", "embed"]
    assert result.fruit_count.count == counted.fruit_count.count
    torch.testing.assert_close(made.gaussians.means, counted.gaussians.means, rtol=0, atol=0)


def test_what_is_watched_lies_in_the_frame_of_the_scene(counted, balls, tmp_path):
    seen = []
    made, _ = reconstruct_scene(balls, tmp_path / "out", config=counted.config, watch=lambda *shown: seen.append(shown))
    middle = made.gaussians.means.median(0).values
    gaussians, scene = seen[0]
    assert float((gaussians.means.median(0).values - middle).norm()) < 0.1 * made.scene.extent
    np.testing.assert_array_equal(scene.cameras[0].center, made.scene.cameras[0].center)


def test_another_up_direction_trains_nothing_again(counted):
    config = dataclasses.replace(counted.config, scene=SceneConfig(up=(0.0, 0.0, 1.0)))
    again = count_scene(counted.out, ["apple"], counted.out.with_name("turned"), config=config)
    assert again.reused == ["train", "embed"]
    np.testing.assert_array_equal(again.scene.up, [0.0, 0.0, 1.0])
    np.testing.assert_array_equal(open_result(again.out).scene.up, [0.0, 0.0, 1.0])
    assert again.config.scene.up == (0.0, 0.0, 1.0)
