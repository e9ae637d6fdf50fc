"""Teaching a word in Blender: examples, the highlight that follows them, and the saved word."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path

import bpy
import numpy as np
import pytest

from fruitlangs.engine.language.taught.word import read_word
from fruitlangs.operators.blender_data import find_owned_object, get_attribute
from fruitlangs.operators.data.fruit_objects import give_members
from fruitlangs.operators.settings.lesson import read_lesson
from fruitlangs.operators.steps import ask, teach

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def settings(extension, counted_balls, tmp_path, monkeypatch):
    """The settings of the counted balls, opened in an empty file; taught words are kept in a folder of the test."""
    monkeypatch.setenv("FRUITLANGS_WORDS", str(tmp_path / "words"))
    folder = shutil.copytree(counted_balls.out, tmp_path / "out")
    assert bpy.ops.fruitlangs.import_scene(directory=str(folder)) == {"FINISHED"}
    found = bpy.context.scene.fruitlangs
    found.teach.word = "fig"
    return found


@pytest.fixture
def ball(counted_balls):
    """The middle of a counted ball."""
    return counted_balls.fruit_count.fruits[0].center


def probability() -> np.ndarray:
    return get_attribute(find_owned_object(bpy.context.scene, "gaussians").data, "probability")


def attend() -> None:
    """What a change and Blender's timers do in a window."""
    ask.ask_soon(bpy.context.scene)
    end = time.monotonic() + 30
    while ask._attend() is not None:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_highlight_follows_each_example(settings, ball, counted_balls):
    members = counted_balls.fruit_count.fruits[0].members
    teach.add_example(settings, ball, positive=True, source="click")
    attend()
    assert settings.prompt == "fig"
    assert settings.answer.problem == ""
    one = probability()
    assert one[members].mean() > 0.5
    assert one.mean() < 0.5
    teach.add_example(settings, ball, positive=False, source="click")
    attend()
    assert "look the same" in settings.answer.problem
    settings.teach.active = 1
    assert bpy.ops.fruitlangs.remove_example() == {"FINISHED"}
    attend()
    assert settings.answer.problem == ""
    np.testing.assert_allclose(probability(), one, atol=1e-6)


def test_a_saved_word_is_what_was_highlighted_and_every_prompt_knows_it(settings, ball, tmp_path):
    teach.add_example(settings, ball, positive=True, source="click")
    attend()
    shown = probability()
    assert bpy.ops.fruitlangs.save_word() == {"FINISHED"}
    file = tmp_path / "words" / "fig.fruitword"
    assert read_word(file).name == "fig"
    assert settings.teach.saved == f"fig: saved as {file}"
    assert "ripe fig" in ask.suggest_prompts(settings, bpy.context, "ripe f")
    settings.teach.examples.clear()
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}
    np.testing.assert_allclose(probability(), shown, atol=1e-6)


def test_reviewed_fruit_become_examples_once(settings):
    fruit = [item for item in bpy.context.scene.objects if item.get("id")]
    for item, verdict in zip(fruit[:2], ("confirmed", "rejected"), strict=True):
        item["review"] = verdict
    assert bpy.ops.fruitlangs.add_reviewed() == {"FINISHED"}
    assert bpy.ops.fruitlangs.add_reviewed() == {"FINISHED"}
    assert sorted(example.positive for example in settings.teach.examples) == [False, True]


def test_reviewed_fruit_teach_the_word_that_the_command_line_teaches(settings, counted_balls, tmp_path):
    one, other = (fruit.id for fruit in counted_balls.fruit_count.fruits[:2])
    fruit = {item["id"]: item for item in bpy.context.scene.objects if item.get("id")}
    fruit[one]["review"], fruit[other]["review"] = "confirmed", "rejected"
    settings.teach.word = "apple"
    assert bpy.ops.fruitlangs.add_reviewed() == {"FINISHED"}
    assert bpy.ops.fruitlangs.save_word() == {"FINISHED"}
    out = tmp_path / "typed" / "apple.fruitword"
    examples = ["--fruit", one, "--not-fruit", other]
    command = [sys.executable, ROOT / "scripts" / "teach_word.py", counted_balls.out, "--word", "apple"]
    subprocess.run([str(part) for part in (*command, *examples, "--out", out)], check=True)
    clicked, typed = read_word(tmp_path / "words" / "apple.fruitword"), read_word(out)
    np.testing.assert_allclose(clicked.weights, typed.weights, atol=1e-6)
    np.testing.assert_array_equal(clicked.vectors, typed.vectors)


def test_a_reviewed_fruit_without_gaussians_is_no_example(settings, counted_balls):
    fruit = [item for item in bpy.context.scene.objects if item.get("id")]
    for item in fruit[:2]:
        item["review"] = "confirmed"
    owners = get_attribute(find_owned_object(bpy.context.scene, "gaussians").data, "fruit_id")
    give_members(bpy.context.scene, np.flatnonzero(owners == fruit[0]["id"]), -1)
    assert bpy.ops.fruitlangs.add_reviewed() == {"FINISHED"}
    assert [example.source for example in settings.teach.examples] == [f"fruit {fruit[1]['id']}"]


def test_without_a_positive_example_nothing_is_taught(settings, ball):
    assert read_lesson(settings) is None
    teach.add_example(settings, ball, positive=False, source="click")
    assert read_lesson(settings) is None
    assert not bpy.ops.fruitlangs.save_word.poll()


def test_one_rejected_place_corrects_a_built_in_word(settings, ball, counted_balls):
    members = counted_balls.fruit_count.fruits[0].members
    settings.prompt, settings.teach.word = "apple", "apple"
    attend()
    before = probability()[members].mean()
    teach.add_example(settings, ball, positive=False, source="click")
    attend()
    assert settings.answer.problem == ""
    assert probability()[members].mean() < 0.5 < before
    assert bpy.ops.fruitlangs.save_word.poll()


def test_a_name_that_cannot_be_a_word_is_a_problem_in_the_panel(settings, ball):
    settings.teach.word = "red fig"
    teach.add_example(settings, ball, positive=True, source="click")
    attend()
    assert "describes fruit" in settings.answer.problem


def test_look_at_needs_a_selected_example(settings, ball):
    assert not bpy.ops.fruitlangs.look_at_example.poll()
    teach.add_example(settings, ball, positive=True, source="click")
    assert bpy.ops.fruitlangs.look_at_example() == {"FINISHED"}


def test_a_word_that_cannot_be_written_is_reported(settings, ball, monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    monkeypatch.setenv("FRUITLANGS_WORDS", str(blocked / "words"))
    teach.add_example(settings, ball, positive=True, source="click")
    with pytest.raises(RuntimeError):
        bpy.ops.fruitlangs.save_word()
    assert not Path(blocked / "words").exists()
