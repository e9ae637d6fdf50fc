"""What the user changed of our objects: a recount, an import or a reconstruction keeps it, or says what it undoes."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from blender_examples import drawn
from mathutils import Euler, Matrix, Vector

from fruitlangs.fruitlangs_addon.panels.step_count import FRUITLANGS_PT_count
from fruitlangs.fruitlangs_addon.panels.step_scene import FRUITLANGS_PT_scene
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, get_attribute
from fruitlangs.operators.data.fruit_objects import REVIEW
from fruitlangs.operators.data.read_cameras import read_cameras, read_up
from fruitlangs.operators.data.read_fruits import read_fruits
from fruitlangs.operators.data.read_gaussians import count_deleted_gaussians
from fruitlangs.operators.data.write_root import write_root
from fruitlangs.operators.photos.photo_backgrounds import background_of
from fruitlangs.operators.root_placement import read_placement
from fruitlangs.operators.settings.settings import read_config
from fruitlangs.operators.steps.show_result import show_result, show_scene
from fruitlangs.operators.viewport.gaussian_nodes import get_input, set_input


def delete_gaussians(*numbers):
    """Delete these Gaussians as the user does in Edit Mode."""
    import bmesh

    item = find_owned_object(bpy.context.scene, "gaussians")
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
    assert len(find_owned_object(bpy.context.scene, "gaussians").data.vertices) == 20
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    assert "Edited" not in bpy.context.scene.fruitlangs.result.notices


def test_a_copied_gaussian_does_not_hide_a_deleted_one(extension, counted, result_of, tmp_path):
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    mesh = delete_gaussians(0, 1).data
    mesh.vertices.add(1)
    mesh.attributes["gaussian_index"].data[18].value = 7
    assert count_deleted_gaussians(bpy.context.scene) == 2


def test_reconstructing_the_same_gaussians_keeps_the_count_and_says_that_deleted_ones_are_back(
    extension, counted_balls, balls, tmp_path
):
    bpy_scene = bpy.context.scene
    bpy_scene.fruitlangs.source, bpy_scene.fruitlangs.out = str(balls), str(counted_balls.out)
    train = bpy_scene.fruitlangs.config.train
    train.steps, train.max_gaussians = 150, 3000
    show_result(bpy.context, bpy_scene, counted_balls)
    owners = get_attribute(find_owned_object(bpy_scene, "gaussians").data, "fruit_id")
    gone = int(np.flatnonzero(owners == 1)[0])
    delete_gaussians(gone)
    assert bpy.ops.fruitlangs.reconstruct() == {"FINISHED"}
    assert bpy_scene.fruitlangs.result.count == counted_balls.fruit_count.count
    assert "Edited Gaussians are as reconstructed again: 1 deleted" in bpy_scene.fruitlangs.result.notices
    after = get_attribute(find_owned_object(bpy_scene, "gaussians").data, "fruit_id")
    np.testing.assert_array_equal(np.delete(after, gone), np.delete(owners, gone))


def test_a_recount_changes_only_the_mesh_of_the_gaussians(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    item, own = find_owned_object(bpy_scene, "gaussians"), bpy.data.collections.new("Mine")
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
    assert find_owned_object(bpy_scene, "gaussians") == item
    assert (item.name, item.hide_render, item.hide_get(), item.data.name) == ("Old tree", True, True, "Old mesh")
    assert [material.name for material in item.data.materials] == ["Bark"]
    assert [modifier.name for modifier in item.modifiers] == ["Gaussians", "Mine"]
    assert get_input(item.modifiers[0], "Reach") == 77.0
    assert item in list(own.objects)
    assert copy.name in bpy_scene.objects
    assert find_owned_objects(bpy_scene, "gaussians") == [item]


def test_sparse_points_that_the_user_shows_or_hides_stay_so(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_scene(bpy.context, bpy_scene, counted.scene)
    item = find_owned_object(bpy_scene, "points")
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert (item.hide_get(), item.hide_render) == (True, True)
    item.hide_set(False)
    item.hide_render = False
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    show_scene(bpy.context, bpy_scene, counted.scene)
    assert find_owned_object(bpy_scene, "points") == item
    assert (item.hide_get(), item.hide_render) == (False, False)


MOVE = Matrix.LocRotScale(Vector((5.0, -7.0, 2.0)), Euler((0.3, 0.1, 1.0)), Vector((100.0, 100.0, 100.0)))
"""What the user did to the root: moved, rotated and scaled it a hundredfold."""


@pytest.fixture
def placed(extension, counted, result_of, tmp_path):
    """The count's scene, with the root moved by the user."""
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    place(find_owned_object(bpy.context.scene, "root"))
    return bpy.context.scene


def place(root):
    root.matrix_basis = MOVE @ root.matrix_basis
    bpy.context.view_layer.update()


def where(bpy_scene) -> np.ndarray:
    return np.array(find_owned_object(bpy_scene, "root").matrix_basis, np.float64)


def test_a_recount_an_import_and_their_like_leave_the_root_where_the_user_put_it(placed, counted, result_of, tmp_path):
    root, own = find_owned_object(placed, "root"), bpy.data.objects.new("Hill", None)
    placed.collection.objects.link(own)
    root.parent, root.name, root.hide_render = own, "My tree", True
    before = where(placed)
    show_result(bpy.context, placed, result_of(counted, tmp_path))
    np.testing.assert_array_equal(where(placed), before)
    show_scene(bpy.context, placed, counted.scene)
    np.testing.assert_array_equal(where(placed), before)
    assert (root.parent, root.name, root.hide_render) == (own, "My tree", True)


def test_reconstructing_leaves_the_root_where_the_user_put_it(extension, counted_balls, balls):
    bpy_scene = bpy.context.scene
    bpy_scene.fruitlangs.source, bpy_scene.fruitlangs.out = str(balls), str(counted_balls.out)
    train = bpy_scene.fruitlangs.config.train
    train.steps, train.max_gaussians = 150, 3000
    show_result(bpy.context, bpy_scene, counted_balls)
    place(find_owned_object(bpy_scene, "root"))
    before = where(bpy_scene)
    assert bpy.ops.fruitlangs.reconstruct() == {"FINISHED"}
    np.testing.assert_allclose(where(bpy_scene), before, rtol=1e-5, atol=1e-4)


def test_a_scale_that_a_count_finds_applies_below_the_users_placement(placed, counted_with, result_of, tmp_path):
    show_result(bpy.context, placed, result_of(counted_with(metres_per_unit=0.25), tmp_path))
    fresh = bpy.data.scenes.new("Fresh")
    expected = MOVE @ write_root(fresh, counted_with(metres_per_unit=0.25).scene).matrix_basis
    np.testing.assert_allclose(where(placed), expected, rtol=1e-4, atol=1e-3)
    assert find_owned_object(placed, "root")["metres_per_unit"] == 0.25


def test_a_measured_length_scales_the_tree_about_its_foot_where_the_user_put_it(placed):
    foot = MOVE @ Vector((0.0, 0.0, 0.0))
    upright = where(placed)
    bpy.ops.fruitlangs.set_length(points=(0, 0, 0, 1, 0, 0), length=0.5)
    np.testing.assert_allclose(where(placed)[:3, :3], 0.5 * upright[:3, :3], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(where(placed)[:3, 3] - foot, 0.5 * (upright[:3, 3] - np.array(foot)), rtol=1e-3)


def test_setting_the_ground_levels_the_tree_and_keeps_its_position_heading_and_size(placed):
    points = [(0.0, 2.0, 3.0), (2.0, 2.0, 3.0), (1.0, 3.0, 4.5)]
    bpy.ops.fruitlangs.set_ground(points=np.ravel(points).tolist())
    bpy.context.view_layer.update()
    world = find_owned_object(placed, "root").matrix_world
    np.testing.assert_allclose([(world @ Vector(point)).z for point in points], 0.0, atol=2e-3)
    user = read_placement(placed)
    np.testing.assert_allclose(user.translation, (5.0, -7.0, 0.0), atol=1e-3)
    np.testing.assert_allclose(user.to_scale(), 100.0, rtol=1e-4)
    heading = MOVE.to_quaternion()
    assert user.to_quaternion().z / user.to_quaternion().w == pytest.approx(heading.z / heading.w, rel=1e-3)


def test_up_and_fruit_do_not_depend_on_where_the_user_put_the_tree(placed, counted):
    np.testing.assert_allclose(read_up(placed), counted.scene.up, atol=1e-5)
    for fruit, true in zip(read_fruits(placed).fruits, counted.fruit_count.fruits, strict=True):
        np.testing.assert_allclose([*fruit.center, fruit.diameter], [*true.center, true.diameter], rtol=1e-4)


def test_a_region_of_a_tilted_tree_is_upright_in_the_scene_and_holds_all_fruit(placed, counted):
    bpy.ops.fruitlangs.add_region()
    config = read_config(placed.fruitlangs).count
    heights = [fruit.center @ counted.scene.up for fruit in counted.fruit_count.fruits]
    assert config.heights[0] < min(heights)
    assert config.heights[1] > max(heights)


def test_the_panel_shows_the_placement_and_resets_it(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    before = where(bpy_scene)
    assert "Placed by you" not in drawn(FRUITLANGS_PT_scene).text
    assert not bpy.ops.fruitlangs.reset_placement.poll()
    place(find_owned_object(bpy_scene, "root"))
    assert "Placed by you: moved, rotated, 100 times as large" in drawn(FRUITLANGS_PT_scene).text
    assert bpy.ops.fruitlangs.reset_placement() == {"FINISHED"}
    np.testing.assert_allclose(where(bpy_scene), before, atol=1e-6)
    assert "Placed by you" not in drawn(FRUITLANGS_PT_scene).text


def test_the_placement_outlives_apply_transform(placed, counted, result_of, tmp_path):
    before = where(placed)
    root = find_owned_object(placed, "root")
    bpy.ops.object.select_all(action="DESELECT")
    root.select_set(True)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.transform_apply()
    show_result(bpy.context, placed, result_of(counted, tmp_path))
    np.testing.assert_allclose(where(placed), before, rtol=1e-4, atol=1e-3)


def test_another_source_is_not_put_where_the_one_before_stood(placed, counted, result_of, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    placed.fruitlangs.result.source = str(tmp_path / "one")
    other = result_of(counted, tmp_path)
    other.origin["source"] = str(tmp_path / "two")
    show_result(bpy.context, placed, other)
    assert read_placement(placed) is None
    assert "its placement was that of" in placed.fruitlangs.result.notices


@pytest.mark.parametrize("scale", [0.01, 100.0])
def test_the_view_turns_to_the_tree_where_the_user_put_it(placed, monkeypatch, scale):
    from fruitlangs.operators.viewport.viewport import look_at_scene

    screens = [screen for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
    view = next(area.spaces.active.region_3d for area in screens[0].areas if area.type == "VIEW_3D")
    root = find_owned_object(placed, "root")
    bpy.ops.fruitlangs.reset_placement()
    look_at_scene(screens, placed)
    place_before, distance = view.view_location.copy(), view.view_distance
    root.matrix_basis = Matrix.Translation((3.0, 4.0, 5.0)) @ Matrix.Scale(scale, 4) @ root.matrix_basis
    look_at_scene(screens, placed)
    np.testing.assert_allclose(view.view_location, scale * place_before + Vector((3.0, 4.0, 5.0)), rtol=1e-4)
    assert view.view_distance == pytest.approx(scale * distance, rel=1e-4)


def fruit(number: int) -> bpy.types.Object:
    return next(item for item in find_owned_objects(bpy.context.scene, "fruit") if item["id"] == number)


def test_a_recount_writes_into_the_fruit_that_it_finds_again(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    item, own = fruit(2), bpy.data.collections.new("Mine")
    bpy_scene.collection.children.link(own)
    own.objects.link(item)
    item.name, item["weight"] = "The large one", 0.2
    item.location.x += 1.0
    item.delta_location.x = 3.0
    item.hide_set(True)
    fruit(1).hide_viewport = True
    bpy.data.materials.new("Wax")
    item.data.materials[0] = bpy.data.materials["Wax"]
    bpy.context.view_layer.objects.active = item
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert fruit(2) == item == bpy.context.view_layer.objects.active
    assert (item.name, item["weight"], item.hide_get(), fruit(1).hide_viewport) == ("The large one", 0.2, True, True)
    assert item in list(own.objects)
    assert {each.data.materials[0].name for each in find_owned_objects(bpy_scene, "fruit")} == {"Wax"}
    assert [mesh.name for mesh in bpy.data.meshes if mesh.name.startswith("apple")] == ["apple"]
    for each, true in zip(read_fruits(bpy_scene).fruits, counted.fruit_count.fruits, strict=True):
        np.testing.assert_allclose(each.center, true.center, atol=1e-5)


def test_an_object_is_not_used_for_another_fruit_of_its_number(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    fruit(2).name = "The large one"
    moved = [dataclasses.replace(each, center=each.center + 1.0) for each in counted.fruit_count.fruits]
    show_result(
        bpy.context,
        bpy_scene,
        result_of(counted, tmp_path, fruit_count=dataclasses.replace(counted.fruit_count, fruits=moved)),
    )
    assert [item.name for item in find_owned_objects(bpy_scene, "fruit")] == ["apple.001", "apple.002", "apple.003"]


def test_of_a_rejected_fruit_a_recount_applies_the_decision_again_and_reopening_shows_it(
    extension, counted, result_of, tmp_path
):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    bpy.ops.object.select_all(action="DESELECT")
    fruit(3).select_set(True)
    bpy.context.view_layer.objects.active = fruit(3)
    bpy.ops.fruitlangs.reject_fruit()
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert (fruit(3)[REVIEW], fruit(3).hide_viewport, fruit(3).hide_render) == ("rejected", True, True)
    bpy.context.view_layer.objects.active = fruit(3)
    bpy.ops.fruitlangs.reopen_fruit()
    assert (fruit(3).hide_viewport, fruit(3).hide_render) == (False, False)
    bpy_scene.fruitlangs.review.log.clear()
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert REVIEW not in fruit(3)


def test_collections_of_trees_stay_and_those_without_fruit_go(extension, counted, result_of, tmp_path):
    def with_trees(*numbers):
        fruits = [
            dataclasses.replace(each, tree=number)
            for each, number in zip(counted.fruit_count.fruits, numbers, strict=True)
        ]
        fruit_count = dataclasses.replace(counted.fruit_count, fruits=fruits)
        show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path, fruit_count=fruit_count))
        return {each.name: [item["id"] for item in each.objects] for each in bpy.data.collections["Trees"].children}

    assert with_trees(1, 1, 2) == {"Tree 1": [1, 2], "Tree 2": [3]}
    bpy.data.collections["Tree 1"].hide_render = True
    assert with_trees(1, 3, 3) == {"Tree 1": [1], "Tree 3": [2, 3]}
    assert bpy.data.collections["Tree 1"].hide_render
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    assert "Trees" not in bpy.data.collections


def test_a_recount_writes_into_the_camera_of_each_photo(extension, counted, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    cameras = find_owned_objects(bpy_scene, "camera")
    item = cameras[4]
    pose = np.array(item.matrix_basis)
    item.hide_viewport, item.data.display_size, item.data.clip_end, item.name = True, 9.0, 77.0, "From the ladder"
    item.data.type, item.data.lens, item.location.x = "ORTHO", 3.0, 99.0
    copy = cameras[2].copy()
    bpy_scene.collection.objects.link(copy)
    bpy_scene.camera, bpy_scene.render.resolution_x = item, 4000
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    assert find_owned_objects(bpy_scene, "camera") == cameras
    assert (item.hide_viewport, item.data.display_size, item.data.clip_end) == (True, 9.0, 77.0)
    assert (bpy_scene.camera, bpy_scene.render.resolution_x, item.name) == (item, 4000, "From the ladder")
    np.testing.assert_allclose(np.array(item.matrix_basis), pose, atol=1e-6)
    np.testing.assert_allclose(read_cameras(bpy_scene)[4].K, counted.scene.cameras[4].K, atol=1e-3)
    assert copy.name in bpy_scene.objects


def test_cameras_of_photos_that_are_no_longer_read_are_removed_and_the_view_is_the_middle(
    extension, counted, result_of, tmp_path
):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    bpy_scene.camera = find_owned_objects(bpy_scene, "camera")[5]
    fewer = dataclasses.replace(counted.scene, cameras=counted.scene.cameras[:4], images=counted.scene.images[:4])
    show_scene(bpy.context, bpy_scene, fewer)
    assert [item["photo"] for item in find_owned_objects(bpy_scene, "camera")] == [photo.name for photo in fewer.images]
    assert bpy_scene.camera in find_owned_objects(bpy_scene, "camera")


def test_clipping_of_cameras_follows_a_scale_that_a_count_finds(extension, counted, counted_with, result_of, tmp_path):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, result_of(counted, tmp_path))
    camera = find_owned_object(bpy_scene, "camera")
    before = camera.data.clip_start
    show_result(bpy.context, bpy_scene, result_of(counted_with(metres_per_unit=0.25), tmp_path))
    assert camera.data.clip_start == pytest.approx(0.25 * before)


def test_the_photo_behind_a_camera_stays_if_it_is_the_same(extension, counted_balls):
    bpy_scene = bpy.context.scene
    show_result(bpy.context, bpy_scene, counted_balls)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = find_owned_object(bpy_scene, "fruit")
    bpy.ops.fruitlangs.best_photo()
    camera = bpy_scene.camera
    show_result(bpy.context, bpy_scene, counted_balls)
    assert bpy_scene.camera == camera
    assert background_of(camera) is not None
    camera["photo_file"] = "/elsewhere/a.jpg"
    show_result(bpy.context, bpy_scene, counted_balls)
    assert background_of(camera) is None
