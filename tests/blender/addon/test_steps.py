"""Every step says how far it is and what it needs next."""

from __future__ import annotations

import dataclasses

import bpy
import pytest
from blender_examples import drawn, imported

from fruitlangs.fruitlangs_addon.panels.steps import CHECKS, ICONS, step_of
from fruitlangs.fruitlangs_addon.registration import CLASSES
from fruitlangs.operators.blender_data import find_owned_objects
from fruitlangs.operators.jobs import jobs
from fruitlangs.operators.steps.show_result import show_result


def states() -> list[str]:
    return [step_of(name, bpy.context.scene).state for name in CHECKS]


def sentence(name) -> str:
    return step_of(name, bpy.context.scene).sentence


@pytest.fixture
def settings(extension):
    return bpy.context.scene.fruitlangs


@pytest.fixture
def count(settings, counted_with, result_of, tmp_path):
    """Show a count of that many fruit of that probability."""

    def count(fruits=3, probability=0.9):
        made = counted_with(fruits=fruits)
        found = [dataclasses.replace(each, probability=probability) for each in made.fruit_count.fruits]
        fruit_count = dataclasses.replace(made.fruit_count, fruits=found)
        show_result(bpy.context, bpy.context.scene, result_of(made, tmp_path, fruit_count=fruit_count))

    return count


def test_one_step_is_next_and_each_that_is_not_done_says_what_it_needs(settings, counted):
    assert states() == ["next", "later", "later", "later", "later", "later"]
    assert all(map(sentence, CHECKS))
    assert "Choose a folder of photos" in sentence("scene")
    settings.source = "/photos"
    assert states() == ["next", "ready", "later", "ready", "later", "later"]
    assert sentence("scene") == "Press Import Scene to show it"
    imported(counted)
    settings.result.cameras = 6
    assert states() == ["done", "next", "later", "ready", "later", "later"]
    assert "runs the steps that are missing" in sentence("count")
    settings.prompt = " , "
    assert states()[3] == "later"
    assert "Enter a prompt in step 3" in sentence("count")


def test_after_a_count_the_review_is_next_where_fruit_are_uncertain_and_says_how_many(count):
    count(probability=0.7)
    assert states() == ["done", "done", "done", "done", "next", "ready"]
    assert sentence("review").startswith("3 fruit below 0.80 are not reviewed yet")
    for item in find_owned_objects(bpy.context.scene, "fruit"):
        item.select_set(True)
    bpy.ops.fruitlangs.confirm_fruit()
    assert (states()[4], sentence("review")) == ("done", "All 3 uncertain fruit are reviewed")


def test_a_review_that_nothing_asked_for_says_so(count):
    count(probability=0.9)
    assert (states()[4], sentence("review")) == ("done", "No uncertain fruit: none is below 0.80")
    count(fruits=0)
    assert "Use Add for fruit that were missed" in sentence("review")


def test_an_export_is_done_until_the_next_count(count, tmp_path):
    count()
    assert states()[5] == "next"
    bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
    assert (states()[5], sentence("export")) == ("done", "Writes the 3 fruit of the reviewed count. Last file: a.csv")
    count()
    assert states()[5] == "next"


def test_a_step_that_failed_is_wrong_and_nothing_after_it_is_next(settings):
    settings.source, settings.result.cameras, settings.failed = "/photos", 6, "Reconstruct"
    assert states() == ["done", "wrong", "later", "ready", "later", "later"]


def test_every_panel_draws_its_sentence_but_while_a_job_is_at_work(settings, monkeypatch):
    panels = [each for each in CLASSES if getattr(each, "step", None)]
    assert [each.step for each in panels] == list(CHECKS)
    for each in panels:
        assert sentence(each.step) in drawn(each).text
    monkeypatch.setattr(
        "fruitlangs.fruitlangs_addon.panels.panel_parts.find_running_job", lambda: jobs.Job("Count", print)
    )
    for each in panels:
        assert sentence(each.step) not in drawn(each).text


def test_every_state_has_a_sign_that_blender_knows(extension):
    known = bpy.types.UILayout.bl_rna.functions["label"].parameters["icon"].enum_items.keys()
    assert set(ICONS.values()) <= set(known)
