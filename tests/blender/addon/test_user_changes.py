"""What the user changed of our objects: a recount, an import or a reconstruction keeps it, or says what it undoes."""

from __future__ import annotations

import bpy
import numpy as np
from blender_examples import drawn

from fruitlangs.fruitlangs_addon.panels.step_count import FRUITLANGS_PT_count
from fruitlangs.operators.blender_data import get_attribute, owned_object, owned_objects
from fruitlangs.operators.data.read_gaussians import deleted_gaussians
from fruitlangs.operators.steps.show_result import show_result, show_scene
from fruitlangs.operators.viewport.gaussian_nodes import get_input, set_input


def delete_gaussians(*numbers):
    """Delete these Gaussians as the user does in Edit Mode."""
    import bmesh

    item = owned_object(bpy.context.scene, "gaussians")
    shape = bmesh.new()
    shape.from_mesh(item.data)
    shape.verts.ensure_lookup_table()
    bmesh.ops.delete(shape, geom=[shape.verts[number] for number in numbers], context="VERTS")
    shape.to_mesh(item.data)
    shape.free()
    return item


def test_a_recount_says_which_gaussians_come_back(extension, counted, result_of, tmp_path):
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    assert "Deleted Gaussians" not in drawn(FRUITLANGS_PT_count).text
    item = delete_gaussians(2, 5, 19)
    item.data.attributes["position"].data[0].vector = (9.0, 9.0, 9.0)
    assert "Deleted Gaussians (3) take part in a count and come back" in drawn(FRUITLANGS_PT_count).text
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    notices = bpy.context.scene.fruitlangs.result.notices
    assert "Edited Gaussians were counted as reconstructed: 3 deleted, 1 moved. To leave out" in notices
    assert len(owned_object(bpy.context.scene, "gaussians").data.vertices) == 20
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    assert "Edited" not in bpy.context.scene.fruitlangs.result.notices


def test_a_copied_gaussian_does_not_hide_a_deleted_one(extension, counted, result_of, tmp_path):
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    mesh = delete_gaussians(0, 1).data
    mesh.vertices.add(1)
    mesh.attributes["gaussian_index"].data[18].value = 7
    assert deleted_gaussians(bpy.context.scene) == 2


def test_reconstructing_the_same_gaussians_keeps_the_count_and_says_that_deleted_ones_are_back(
    extension, counted_balls, balls, tmp_path
):
    bpy_scene = bpy.context.scene
    bpy_scene.fruitlangs.source, bpy_scene.fruitlangs.out = str(balls), str(counted_balls.out)
    train = bpy_scene.fruitlangs.config.train
    train.steps, train.max_gaussians = 150, 3000
    show_result(bpy.context, bpy_scene, counted_balls)
    owners = get_attribute(owned_object(bpy_scene, "gaussians").data, "fruit_id")
    gone = int(np.flatnonzero(owners == 1)[0])
    delete_gaussians(gone)
    assert bpy.ops.fruitlangs.reconstruct() == {"FINISHED"}
    assert bpy_scene.fruitlangs.result.count == counted_balls.fruit_count.count
    assert "Edited Gaussians are as reconstructed again: 1 deleted" in bpy_scene.fruitlangs.result.notices
    after = get_attribute(owned_object(bpy_scene, "gaussians").data, "fruit_id")
    np.testing.assert_array_equal(np.delete(after, gone), np.delete(owners, gone))


def test_a_recount_changes_only_the_mesh_of_the_gaussians(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    item, own = owned_object(bpy_scene, "gaussians"), bpy.data.collections.new("Mine")
    bpy_scene.collection.children.link(own)
    own.objects.link(item)
    item.name, item.hide_render, item.data.name = "Old tree", True, "Old mesh"
    item.data.materials.append(bpy.data.materials.new("Bark"))
    item.modifiers.new("Mine", "WAVE")
    set_input(item.modifiers[0], "Reach", 77.0)
    item.hide_set(True)
    copy = item.copy()
    copy.data = item.data.copy()
    bpy_scene.collection.objects.link(copy)
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert owned_object(bpy_scene, "gaussians") == item
    assert (item.name, item.hide_render, item.hide_get(), item.data.name) == ("Old tree", True, True, "Old mesh")
    assert [material.name for material in item.data.materials] == ["Bark"]
    assert [modifier.name for modifier in item.modifiers] == ["Gaussians", "Mine"]
    assert get_input(item.modifiers[0], "Reach") == 77.0
    assert item in list(own.objects)
    assert copy.name in bpy_scene.objects
    assert owned_objects(bpy_scene, "gaussians") == [item]


def test_sparse_points_that_the_user_shows_or_hides_stay_so(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_scene(bpy.context, bpy_scene, counted.scene)
    item = owned_object(bpy_scene, "points")
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert (item.hide_get(), item.hide_render) == (True, True)
    item.hide_set(False)
    item.hide_render = False
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    show_scene(bpy.context, bpy_scene, counted.scene)
    assert owned_object(bpy_scene, "points") == item
    assert (item.hide_get(), item.hide_render) == (False, False)
