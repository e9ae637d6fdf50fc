"""A scene.blend that the command line wrote shows in the panel what an import of its result shows."""

from __future__ import annotations

import dataclasses
import shutil
from functools import partial
from pathlib import Path

import bpy
import pytest
from blender_examples import drawn

import fruitlangs
from fruitlangs.engine.open_result import open_result
from fruitlangs.fruitlangs_addon.panels.step_count import FRUITLANGS_PT_count
from fruitlangs.fruitlangs_addon.panels.step_review import FRUITLANGS_PT_review
from fruitlangs.operators.data.stored_review import keep_corrections, review_line
from fruitlangs.operators.data.write import write_blend
from fruitlangs.operators.settings.panel_state import STORED, PanelState, panel_state, read_stored_panel
from fruitlangs.operators.settings.settings import is_of_another, make_relative_path, result_folder, source_folder

PARTS = ("scene", "gaussians", "probability", "fruit_count")


@pytest.fixture
def folder(counted_balls, balls, tmp_path):
    """A folder that contains photos and their result, with a scene.blend that was written without the extension."""
    shutil.copytree(balls, tmp_path / "before" / "balls")
    out = shutil.copytree(counted_balls.out, tmp_path / "before" / "balls_fruit")
    result = dataclasses.replace(open_result(out), out=out)
    result.origin["source"] = str(tmp_path / "before" / "balls")
    (out / "cache").mkdir(exist_ok=True)
    (out / "cache" / "source.txt").write_text(f"{tmp_path / 'before' / 'balls'}\n../balls\n")
    assert not hasattr(bpy.types.Scene, "fruitlangs")
    write_blend(
        out / "scene.blend",
        *(getattr(result, name) for name in PARTS),
        set_id=result.set_id,
        threshold=result.config.count.threshold,
        folder=out,
        panel=panel_state(result, partial(make_relative_path, folder=out)),
    )
    return tmp_path / "before"


@pytest.fixture
def registered(folder):
    fruitlangs.register()
    try:
        yield folder
    finally:
        fruitlangs.unregister()


def opened(folder: Path):
    bpy.ops.wm.open_mainfile(filepath=str(folder / "balls_fruit" / "scene.blend"))
    return bpy.context.scene


def values(group) -> dict[str, object]:
    """The plain properties of a property group."""
    kinds = {"STRING", "INT", "FLOAT", "BOOLEAN"}
    names = [each.identifier for each in group.bl_rna.properties if each.type in kinds]
    return {name: getattr(group, name) for name in names if name != "name"}


def test_it_shows_what_an_import_of_the_result_shows(registered):
    scene = opened(registered)
    stored = values(scene.fruitlangs.result)
    words = scene.fruitlangs.prompt, scene.fruitlangs.negative, scene.fruitlangs.config.count.threshold
    line, text = review_line(scene), drawn(FRUITLANGS_PT_count).text
    assert stored["count"] > 0
    assert "90 % interval" in line
    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(registered / "balls_fruit" / "other.blend"))
    bpy.ops.fruitlangs.import_scene(directory=str(registered / "balls_fruit"))
    scene = bpy.context.scene
    assert values(scene.fruitlangs.result) == pytest.approx(stored)
    assert (scene.fruitlangs.prompt, scene.fruitlangs.negative, scene.fruitlangs.config.count.threshold) == words
    assert (review_line(scene), drawn(FRUITLANGS_PT_count).text) == (line, text)


def test_its_paths_are_relative_and_survive_a_move_of_the_folder(registered, tmp_path):
    moved = shutil.move(registered, tmp_path / "after")
    scene = opened(Path(moved))
    settings = scene.fruitlangs
    paths = [settings.source, settings.result.source, settings.result.folder, settings.result.features]
    assert all(path.startswith("//") for path in paths)
    assert "before" not in " ".join(paths)
    assert source_folder(settings) == tmp_path / "after" / "balls_fruit"
    assert not is_of_another(settings, tmp_path / "after" / "balls")
    assert not is_of_another(settings, source_folder(settings))
    assert result_folder(settings)
    assert Path(bpy.path.abspath(settings.result.features)).is_file()


def test_it_is_reviewed_as_after_an_import(registered, tmp_path):
    scene = opened(registered)
    assert "next_uncertain" in drawn(FRUITLANGS_PT_review).buttons
    first = next(item for item in scene.objects if item.get("fruitlangs") == "fruit")
    number = first["id"]
    for item in scene.objects:
        item.select_set(item == first)
    bpy.ops.object.delete()
    assert keep_corrections(scene) == [f"deleted by hand and rejected in the log: {number}"]
    before = scene.fruitlangs.result.count
    bpy.ops.fruitlangs.add_fruit(center=tuple(scene.objects["FruitLangs"].children[-1].location))
    assert scene["fruitlangs_last_id"] > before
    bpy.ops.wm.save_mainfile()
    assert STORED not in scene
    scene = opened(registered)
    assert len(scene.fruitlangs.review.log) == 2


def test_a_file_that_is_open_already_follows_when_the_extension_is_enabled(folder):
    scene = opened(folder)
    assert STORED in scene
    fruitlangs.register()
    try:
        assert bpy.context.scene.fruitlangs.result.count > 0
        assert STORED not in bpy.context.scene
    finally:
        fruitlangs.unregister()


@pytest.mark.parametrize("text", ["", "{}", "[1]", '{"scene": 3}', '{"unknown": 1}'])
def test_what_another_version_stored_is_left_alone(registered, text):
    scene = opened(registered)
    scene[STORED] = text
    assert read_stored_panel(scene) is None


def test_the_state_comes_back_from_its_text(folder):
    state = read_stored_panel(opened(folder))
    assert isinstance(state, PanelState)
    assert (state.chosen, state.source) == ("//.", "//../balls")
    assert state.count.low <= state.count.count <= state.count.high
