"""What a .blend keeps: through saving, moving, undo, two scenes in one file, and odd modes."""

from __future__ import annotations

import shutil
from pathlib import Path

import bpy
import numpy as np
import pytest

from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, get_attribute
from fruitlangs.operators.jobs.target_scene import Target
from fruitlangs.operators.packages.caches import list_work_caches
from fruitlangs.operators.steps.show_result import show_result


def open_balls(counted_balls, folder: Path) -> None:
    """A copy of the counted balls in `folder`/out, opened in `folder`/tree.blend, which is saved."""
    shutil.copytree(counted_balls.out, folder / "out")
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "tree.blend"))
    bpy.ops.fruitlangs.import_scene(directory=str(folder / "out"))
    bpy.ops.wm.save_mainfile()


def everything() -> dict:
    """All that the panel and the viewport show, as plain values."""
    scene = bpy.context.scene
    item = find_owned_object(scene, "gaussians")
    attributes = {name: get_attribute(item.data, name).tolist() for name in ("position", "scale", "probability")}
    fruit = {
        each.name: (*np.array(each.matrix_basis).ravel(), *(str(each[key]) for key in ("id", "label", "kind")))
        for each in find_owned_objects(scene, "fruit")
    }
    result = scene.fruitlangs.result
    names = {each.identifier for each in result.bl_rna.properties} - {"rna_type", "name"}
    texts = {name: getattr(result, name) for name in sorted(names)}
    return {"attributes": attributes, "fruit": fruit, "texts": texts, "prompt": scene.fruitlangs.prompt}


def test_a_saved_file_shows_the_same_when_it_is_opened_again(extension, counted_balls, tmp_path):
    open_balls(counted_balls, tmp_path)
    before = everything()
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "tree.blend"))
    assert everything() == before


def test_a_file_moved_with_its_results_still_answers(extension, counted_balls, tmp_path):
    (tmp_path / "here").mkdir()
    open_balls(counted_balls, tmp_path / "here")
    bpy.ops.wm.read_factory_settings(use_empty=True)
    shutil.move(tmp_path / "here", tmp_path / "there")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "there" / "tree.blend"))
    bpy.context.scene.fruitlangs.prompt = "grass"
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}


def test_a_file_moved_without_its_results_says_so_and_loses_nothing(extension, counted_balls, tmp_path):
    open_balls(counted_balls, tmp_path)
    fruit = len(find_owned_objects(bpy.context.scene, "fruit"))
    shutil.rmtree(tmp_path / "out")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "tree.blend"))
    with pytest.raises(RuntimeError, match=r"features in .* are missing. Press Reconstruct"):
        bpy.ops.fruitlangs.ask()
    with pytest.raises(RuntimeError, match=r"does not exist. Choose it again"):
        bpy.ops.fruitlangs.count()
    assert len(find_owned_objects(bpy.context.scene, "fruit")) == fruit == bpy.context.scene.fruitlangs.result.count


def test_two_scenes_in_one_file_each_keep_their_own(extension, counted, counted_with, result_of, tmp_path):
    first, second = bpy.context.scene, bpy.data.scenes.new("Row 2")
    show_result(bpy.context, first, result_of(counted, tmp_path / "one"))
    pears = counted_with(label="pear", fruits=2)
    show_result(bpy.context, second, result_of(pears, tmp_path / "two"))
    assert [item["label"] for item in find_owned_objects(first, "fruit")] == ["apple"] * 3
    assert [item["label"] for item in find_owned_objects(second, "fruit")] == ["pear"] * 2
    assert (first.fruitlangs.result.count, second.fruitlangs.result.count) == (3, 2)
    assert find_owned_object(first, "gaussians") != find_owned_object(second, "gaussians")


def test_a_count_that_ends_in_edit_mode_is_shown_all_the_same(extension, counted, result_of, tmp_path):
    bpy.ops.mesh.primitive_cube_add()
    target = Target(bpy.context.scene)
    bpy.ops.object.mode_set(mode="EDIT")
    show_result(bpy.context, target.scene(bpy.context), result_of(counted, tmp_path))
    assert bpy.context.mode == "OBJECT"
    assert len(find_owned_objects(bpy.context.scene, "fruit")) == 3


def test_a_count_that_ends_leaves_the_user_in_the_edit_mode_of_another_scene(extension, counted, result_of, tmp_path):
    first, second = bpy.context.scene, bpy.data.scenes.new("Row 2")
    target = Target(first)
    bpy.context.window.scene = second
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.mode_set(mode="EDIT")
    show_result(bpy.context, target.scene(bpy.context), result_of(counted, tmp_path))
    assert bpy.context.mode == "EDIT_MESH"
    assert len(find_owned_objects(first, "fruit")) == 3


def test_a_count_that_ends_leaves_the_edit_mode_of_its_scene_in_another_window(extension, counted, result_of, tmp_path):
    first, second = bpy.context.scene, bpy.data.scenes.new("Row 2")
    target = Target(first)
    bpy.ops.mesh.primitive_cube_add()
    bpy.ops.object.mode_set(mode="EDIT")
    with bpy.context.temp_override(scene=second, view_layer=second.view_layers[0]):  # the timer's window shows this one
        show_result(bpy.context, target.scene(bpy.context), result_of(counted, tmp_path))
    assert bpy.context.mode == "OBJECT"
    assert len(find_owned_objects(first, "fruit")) == 3


def test_gaussians_in_edit_mode_are_not_written_and_it_is_reported(extension, counted_balls, tmp_path):
    open_balls(counted_balls, tmp_path)
    item = find_owned_object(bpy.context.scene, "gaussians")
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    with pytest.raises(RuntimeError, match="Edit Mode"):
        bpy.ops.fruitlangs.ask()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert bpy.ops.fruitlangs.ask() == {"FINISHED"}


def test_gaussians_deleted_meanwhile_come_back_with_the_next_count(extension, counted, result_of, tmp_path):
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    bpy.data.objects.remove(find_owned_object(bpy.context.scene, "gaussians"))
    bpy.data.objects.remove(find_owned_object(bpy.context.scene, "root"))
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    assert find_owned_object(bpy.context.scene, "gaussians").parent == find_owned_object(bpy.context.scene, "root")
    assert len(find_owned_objects(bpy.context.scene, "fruit")) == 3


ON_A_SCENE = ("import_scene", "reconstruct", "count", "ask", "export_csv")
ON_FRUIT = ("confirm_fruit", "add_fruit", "next_uncertain", "best_photo")
MEASURING = ("measure", "set_length", "set_ground", "add_region")


@pytest.mark.parametrize("name", [*ON_A_SCENE, *ON_FRUIT, *MEASURING])
def test_a_linked_scene_is_reported_before_anything_is_done_in_it(extension, tmp_path, name):
    bpy.context.scene.name = "Orchard"
    bpy.context.scene.fruitlangs.source = str(tmp_path)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "library.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "library.blend"), link=True) as (_, here):
        here.scenes = ["Orchard"]
    bpy.context.window.scene = bpy.data.scenes["Orchard"]
    with pytest.raises(RuntimeError, match=r"linked from another file. Make it local first"):
        getattr(bpy.ops.fruitlangs, name)()


def test_all_that_a_run_keeps_next_to_its_results_is_what_can_be_cleared(extension, counted_balls, tmp_path):
    bpy.context.scene.fruitlangs.out = str(counted_balls.out)
    kept = sorted(path for path in (counted_balls.out / "cache").iterdir() if path.is_dir())
    assert kept == list_work_caches(bpy.context.scene) != []


def test_undo_takes_an_import_back_and_redo_brings_it_again(extension, counted_balls, tmp_path):
    folder = shutil.copytree(counted_balls.out, tmp_path / "out")
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.fruitlangs.import_scene(directory=str(folder))
    bpy.ops.ed.undo_push(message="Import")
    bpy.ops.ed.undo()
    assert find_owned_object(bpy.context.scene, "gaussians") is None
    assert bpy.context.scene.fruitlangs.result.count == -1
    bpy.ops.ed.redo()
    assert find_owned_object(bpy.context.scene, "gaussians") is not None
    assert bpy.context.scene.fruitlangs.result.count == counted_balls.fruit_count.count
