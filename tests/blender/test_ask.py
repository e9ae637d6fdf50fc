"""The first steps of the day on a real scene: a result opens, words are asked, a reconstruction is asked too."""

from __future__ import annotations

import dataclasses
import shutil
import time

import bpy
import numpy as np
import pytest
import torch
from blender_examples import written

from fruitlangs.engine.language.features.features import load_features, save_features
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, get_attribute, set_attribute
from fruitlangs.operators.data.write_gaussians import ASKED
from fruitlangs.operators.steps import ask


@pytest.fixture
def opened(extension, counted_balls, tmp_path):
    """The counted balls, opened in an empty file; their folder is a copy."""
    folder = shutil.copytree(counted_balls.out, tmp_path / "out")
    assert bpy.ops.fruitlangs.import_scene(directory=str(folder)) == {"FINISHED"}
    return folder


def probability() -> np.ndarray:
    return get_attribute(find_owned_object(bpy.context.scene, "gaussians").data, "probability")


def attend() -> None:
    """What Blender's timers do in a window."""
    end = time.monotonic() + 30
    while ask._attend() is not None:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_an_opened_result_shows_all_that_was_counted(opened, counted_balls):
    settings = bpy.context.scene.fruitlangs
    assert (
        len(find_owned_objects(bpy.context.scene, "fruit")) == counted_balls.fruit_count.count == settings.result.count
    )
    assert (settings.prompt, settings.config.count.threshold) == ("apple", pytest.approx(0.3))
    assert len(find_owned_objects(bpy.context.scene, "camera")) == len(counted_balls.scene.cameras)
    np.testing.assert_allclose(probability(), counted_balls.probability.numpy(), atol=1e-6)
    fit = int((counted_balls.probability >= 0.3).sum())
    assert settings.answer.text.startswith(f"{fit:,} of {len(counted_balls.gaussians):,} Gaussians match")


def test_another_word_changes_the_highlight_and_its_text(opened, counted_balls):
    settings = bpy.context.scene.fruitlangs
    before, said = probability(), settings.answer.text
    settings.prompt = "grass"
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}
    assert np.corrcoef(before, probability())[0, 1] < 0.0
    assert settings.answer.text != said


def test_an_answered_prompt_is_not_computed_again_and_an_old_problem_is_cleared(opened, monkeypatch):
    settings = bpy.context.scene.fruitlangs
    before, said = probability(), settings.answer.text
    settings.answer.problem = "durian is no word"
    monkeypatch.setattr(ask, "answer", lambda *_: pytest.fail("asked"))
    ask.ask_soon(bpy.context.scene)
    attend()
    np.testing.assert_array_equal(probability(), before)
    assert (settings.answer.problem, settings.answer.text) == ("", said)


def test_the_button_asks_again_without_stopping_the_window(opened, monkeypatch):
    before = probability()
    monkeypatch.setattr(ask, "has_window", lambda: True)
    item = find_owned_object(bpy.context.scene, "gaussians")
    set_attribute(item.data, "probability", "FLOAT", np.zeros(len(before), np.float32))
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}
    assert not probability().any()
    attend()
    np.testing.assert_allclose(probability(), before, atol=1e-6)


def test_a_threshold_moved_before_anything_was_asked_gives_nothing(extension, counted):
    written(counted)
    bpy.context.scene.fruitlangs.config.count.threshold = 0.7
    assert bpy.context.scene.fruitlangs.answer.text == ""


def test_an_unknown_word_is_reported_and_the_highlight_stays(opened):
    before = probability()
    bpy.context.scene.fruitlangs.prompt = "durian"
    with pytest.raises(RuntimeError, match="does not know the word 'durian'"):
        bpy.ops.fruitlangs.ask()
    assert "durian" in bpy.context.scene.fruitlangs.answer.problem
    np.testing.assert_array_equal(probability(), before)


def test_features_that_vanished_are_a_report_that_says_what_to_do(opened):
    (opened / "features.safetensors").unlink()
    with pytest.raises(RuntimeError, match=r"features in .* are missing. Press Reconstruct"):
        bpy.ops.fruitlangs.ask()


def test_features_of_more_gaussians_are_refused(opened):
    item = find_owned_object(bpy.context.scene, "gaussians")
    item.data.vertices.add(1)
    with pytest.raises(RuntimeError, match="features of other Gaussians than those shown"):
        bpy.ops.fruitlangs.ask()


def replaced_by(file, means) -> None:
    """Leave in the file features of as many other Gaussians, as a later run does."""
    features = load_features(file)
    others = torch.randperm(len(features), generator=torch.Generator().manual_seed(0))
    shuffled = {name: getattr(features, name)[others] for name in ("vectors", "weights", "agreement")}
    features = dataclasses.replace(features, **shuffled, gaussians="")
    save_features(file, features if means is None else features.of(means[others]))


def test_features_of_as_many_other_gaussians_are_refused_and_the_highlight_stays(opened, counted_balls):
    before = probability()
    replaced_by(opened / "features.safetensors", counted_balls.gaussians.means)
    with pytest.raises(RuntimeError, match=r"other Gaussians than those shown.* Press Reconstruct or count again"):
        bpy.ops.fruitlangs.ask()
    np.testing.assert_array_equal(probability(), before)


def test_features_of_an_older_file_that_does_not_say_whose_they_are_answer_still(opened):
    replaced_by(opened / "features.safetensors", None)
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}


def test_the_timer_answers_the_last_of_several_edits(opened):
    settings = bpy.context.scene.fruitlangs
    for words in ("leaf", "apple", "grass"):
        settings.prompt = words
        ask.ask_soon(bpy.context.scene)
    attend()
    item = find_owned_object(bpy.context.scene, "gaussians")
    assert item.data[ASKED] == "grass | "
    by_timer = probability()
    bpy.ops.fruitlangs.ask()
    np.testing.assert_array_equal(by_timer, probability())


def test_an_answer_to_words_that_were_edited_is_computed_again(opened):
    settings = bpy.context.scene.fruitlangs
    settings.prompt = "leaf"
    ask.ask_soon(bpy.context.scene)
    assert ask._attend() is not None
    settings.prompt = "grass"
    attend()
    assert find_owned_object(bpy.context.scene, "gaussians").data[ASKED] == "grass | "


def test_an_answer_for_a_scene_deleted_meanwhile_is_dropped(opened):
    bpy.context.scene.fruitlangs.prompt = "leaf"
    ask.ask_soon(bpy.context.scene)
    assert ask._attend() is not None
    bpy.ops.wm.read_factory_settings(use_empty=True)
    attend()
    assert find_owned_object(bpy.context.scene, "gaussians") is None


def test_the_threshold_changes_how_many_fit(opened):
    settings = bpy.context.scene.fruitlangs
    settings.config.count.threshold = 0.9
    assert settings.answer.text.startswith(f"{int((probability() >= np.float32(0.9)).sum()):,} of")


def test_suggestions_complete_the_last_word_and_keep_those_before(extension):
    offered = ask.suggest_prompts(None, None, "apple, red p")
    assert offered[0] == "apple, red pear"
    assert all(words.startswith("apple, ") for words in offered)
    assert "fruit" in ask.suggest_prompts(None, None, "")


def test_reconstruct_shows_gaussians_that_a_count_then_finds(extension, balls, counted_balls, tmp_path):
    settings = bpy.context.scene.fruitlangs
    settings.source, settings.out = str(balls), str(tmp_path / "out")
    settings.config.train.steps, settings.config.train.max_gaussians = 150, 3000
    settings.config.count.threshold = 0.3
    bpy.ops.fruitlangs.import_scene()
    assert bpy.ops.fruitlangs.reconstruct() == {"FINISHED"}
    assert settings.result.gaussians == len(counted_balls.gaussians)
    assert settings.result.quality.startswith("held-out photos: PSNR")
    bpy.ops.fruitlangs.ask()
    np.testing.assert_allclose(probability(), counted_balls.probability.numpy(), atol=1e-6)
    assert bpy.ops.fruitlangs.count() == {"FINISHED"}
    assert settings.result.count == counted_balls.fruit_count.count


def test_a_ply_of_another_program_is_imported_and_asked(extension, counted_balls, tmp_path, monkeypatch):
    monkeypatch.setattr("fruitlangs.engine.splatting.subject.viewpoints.VIEWS", 6)
    shutil.copy(counted_balls.out / "gaussians.ply", tmp_path / "tree.ply")
    settings = bpy.context.scene.fruitlangs
    settings.source = str(tmp_path / "tree.ply")
    assert bpy.ops.fruitlangs.import_scene() == {"FINISHED"}
    assert settings.result.gaussians == len(counted_balls.gaussians)
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}
