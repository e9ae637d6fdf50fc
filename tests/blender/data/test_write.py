from __future__ import annotations

import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import bpy
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view

from fruitlangs.engine.errors import OutputError
from fruitlangs.engine.language.vocabulary import FRUITS
from fruitlangs.engine.scene.camera import Camera, Scene, look_along
from fruitlangs.operators.blender_data import find_owned_objects, get_attribute
from fruitlangs.operators.data.photo_files import photo_path
from fruitlangs.operators.data.write import save_blend, write_blend, write_result
from fruitlangs.operators.data.write_cameras import find_middle_view
from fruitlangs.operators.data.write_gaussians import ASKED, join_asked_words
from fruitlangs.operators.data.write_points import write_points
from fruitlangs.operators.data.write_root import find_focus, write_root
from fruitlangs.operators.viewport.fruit_colours import LABEL_HUES

PARTS = ("scene", "gaussians", "probability", "fruit_count")
SCRIPTS = Path(__file__).resolve().parents[3] / "scripts"


def written(counted):
    root = write_result(bpy.context.scene, *counted.parts())
    bpy.context.view_layer.update()
    return root


def test_gaussian_attributes_hold_the_engine_values(counted):
    written(counted)
    mesh = bpy.data.objects["Gaussians"].data
    gaussians = counted.gaussians
    unit_quats = gaussians.quats / gaussians.quats.norm(dim=1, keepdim=True)
    for name, expected in {
        "position": gaussians.means,
        "scale": gaussians.scales,
        "quaternion": unit_quats,
        "opacity": gaussians.opacities,
        "probability": counted.probability,
    }.items():
        np.testing.assert_allclose(get_attribute(mesh, name), expected, atol=1e-6, err_msg=name)


def test_base_colour_is_stored_linear(counted):
    written(counted)
    stored = get_attribute(bpy.data.objects["Gaussians"].data, "radiance:base")
    srgb = counted.gaussians.base_colors.numpy()
    np.testing.assert_allclose(stored[:, :3], ((srgb + 0.055) / 1.055) ** 2.4, atol=1e-5)
    assert (stored[:, 3] == 1).all()


def test_members_of_a_fruit_carry_its_id_and_others_minus_one(counted):
    written(counted)
    ids = get_attribute(bpy.data.objects["Gaussians"].data, "fruit_id")
    assert ids.tolist() == [1, 1, 2, 2, 3, 3] + [-1] * 14


def test_instances_are_ellipsoids_of_the_gaussians_axes(counted):
    written(counted)
    evaluated = bpy.context.evaluated_depsgraph_get()
    # instance matrices on top of the root's; every opaque enough Gaussian has one
    instances = [
        np.array(item.matrix_world)
        for item in evaluated.object_instances
        if item.is_instance and item.parent.name == "Gaussians"
    ]
    shown = (counted.gaussians.opacities >= 0.1).numpy()
    assert len(instances) == shown.sum()
    # The ellipsoid x = M·u, |u| = 1, has the covariance M Mᵀ / size²; 1.5 is the modifier's default size.
    root = np.array(bpy.data.objects["FruitLangs"].matrix_world)[:3, :3]
    expected = root @ counted.gaussians.covariances.numpy()[shown] @ root.T
    covariances = np.stack([m[:3, :3] @ m[:3, :3].T / 1.5**2 for m in instances])
    np.testing.assert_allclose(covariances, expected, rtol=1e-3, atol=1e-9)


def test_more_gaussians_than_the_limit_become_points(counted):
    from fruitlangs.operators.viewport.gaussian_nodes import set_input

    written(counted)
    item = bpy.data.objects["Gaussians"]
    set_input(item.modifiers[0], "Ellipsoids up to", 5)
    item.update_tag()
    evaluated = bpy.context.evaluated_depsgraph_get()
    clouds = [
        (one.object.type, len(one.object.data.attributes["position"].data))
        for one in evaluated.object_instances
        if one.is_instance
    ]
    assert clouds == [("POINTCLOUD", int((counted.gaussians.opacities >= 0.1).sum()))]


def test_fruit_are_named_by_label_and_id_and_share_a_mesh(counted):
    written(counted)
    fruits = bpy.data.collections["Fruits"].objects
    assert sorted(fruits.keys()) == ["apple.001", "apple.002", "apple.003"]
    assert len({item.data.name for item in fruits}) == 1
    assert bpy.data.collections["Fruits"] in list(bpy.context.scene.collection.children_recursive)


def test_fruit_keep_the_input_frame_below_the_root(counted):
    written(counted)
    fruit = counted.fruit_count.fruits[1]
    item = bpy.data.objects["apple.002"]
    np.testing.assert_allclose(item.location, fruit.center, atol=1e-6)
    np.testing.assert_allclose(item.dimensions, fruit.lengths, rtol=1e-3)
    corners = np.array([item.matrix_local @ vertex.co for vertex in item.data.vertices])
    half = np.abs(fruit.axes).max(axis=0)  # the test's axes lie along the frame's
    np.testing.assert_allclose(corners.max(axis=0), fruit.center + half, rtol=1e-2)


def test_fruit_carry_their_properties(counted):
    written(counted)
    item = bpy.data.objects["apple.002"]
    assert (item["id"], item["label"], item["kind"]) == (2, "apple", "single")
    assert item["diameter"] == pytest.approx(0.2)
    assert [item[name] for name in ("length", "width", "thickness")] == pytest.approx([0.4, 0.2, 0.1])
    assert item["probability"] == pytest.approx(0.9)
    assert item["visible_fraction"] == pytest.approx(0.25)
    assert "visible_fraction" not in bpy.data.objects["apple.001"]
    assert item["views"] == 7
    assert list(item["color"]) == pytest.approx([1.0, 0.2, 0.0])


def test_fruit_say_where_they_are_only_where_it_is_known(counted):
    hanging, lying, unknown = counted.fruit_count.fruits
    known = [dataclasses.replace(hanging, fallen=False, tree=2), dataclasses.replace(lying, fallen=True), unknown]
    written(dataclasses.replace(counted, fruit_count=dataclasses.replace(counted.fruit_count, fruits=known)))
    items = [bpy.data.objects[f"apple.{number:03d}"] for number in (1, 2, 3)]
    assert [item.get("fallen") for item in items] == [False, True, None]
    assert [item.get("tree") for item in items] == [2, None, None]


def test_up_becomes_plus_z_and_distances_stay(counted):
    root = written(counted)
    up = np.array(root.matrix_world)[:3, :3] @ counted.scene.up
    np.testing.assert_allclose(up, [0, 0, 1], atol=1e-6)
    first, last = (np.array(bpy.data.objects[f"apple.00{k}"].matrix_world.translation) for k in (1, 3))
    np.testing.assert_allclose(last - first, 0.6 * np.array(root.matrix_world)[:3, 0], atol=1e-6)


def test_the_point_all_cameras_look_at_stands_over_the_origin(counted):
    np.testing.assert_allclose(find_focus(counted.scene), [1, 2, 3], atol=1e-9)
    root = written(counted)
    world = np.array(root.matrix_world)
    middle = world[:3, :3] @ [1, 2, 3] + world[:3, 3]
    np.testing.assert_allclose(middle[:2], 0, atol=1e-6)
    heights = counted.scene.points @ world[2, :3] + world[2, 3]
    assert -0.2 < heights.min() <= 0 < np.median(heights)


def test_a_known_scale_makes_metres(counted_with):
    counted = counted_with(metres_per_unit=0.5)
    root = written(counted)
    assert root.matrix_world.to_scale()[0] == pytest.approx(0.5)
    assert bpy.data.objects["apple.002"]["diameter"] == pytest.approx(0.1)
    first, last = (bpy.data.objects[f"apple.00{k}"].matrix_world.translation for k in (1, 3))
    assert (last - first).length == pytest.approx(0.3, rel=1e-5)


@pytest.mark.parametrize("metres_per_unit", [None, 0.001, 20.0])
def test_cameras_clip_nothing_that_they_look_at_whatever_the_unit(counted_with, metres_per_unit):
    counted = counted_with(metres_per_unit=metres_per_unit)
    written(counted)
    distance = np.linalg.norm(counted.scene.cameras[0].center - [1, 2, 3]) * (metres_per_unit or 1.0)
    clip = bpy.data.collections["Cameras"].objects[0].data
    assert clip.clip_start < 0.01 * distance
    assert clip.clip_end > 10.0 * distance


def test_every_camera_sees_a_fruit_at_the_pixel_of_its_projection(counted):
    written(counted)
    bpy_scene = bpy.context.scene
    assert (bpy_scene.render.resolution_x, bpy_scene.render.resolution_y) == (160, 90)
    fruit = bpy.data.objects["apple.003"]
    for camera, item in zip(counted.scene.cameras, bpy.data.collections["Cameras"].objects, strict=True):
        x, y, z = camera.world_to_camera[:3, :3] @ fruit.location + camera.world_to_camera[:3, 3]
        expected = [210.0 * x / z + 70.0, 190.0 * y / z + 41.0]
        seen = world_to_camera_view(bpy_scene, item, fruit.matrix_world.translation)
        np.testing.assert_allclose([seen.x * 160, (1 - seen.y) * 90], expected, atol=1e-3)


def test_cameras_are_named_after_their_photos_and_one_is_active(counted):
    written(counted)
    cameras = bpy.data.collections["Cameras"].objects
    assert cameras.keys() == [f"photo_{index}" for index in range(6)]
    assert cameras[2]["photo"] == "row/photo_2.jpg"
    assert bpy.context.scene.camera in list(cameras)


def test_a_row_is_first_shown_from_its_middle_and_a_walk_around_a_tree_from_its_middle_photo() -> None:
    def camera(place: list[float], along: list[float]) -> Camera:
        pose = look_along(np.array(place), np.array(along), np.array([0.0, 0.0, 1.0]))
        return Camera(width=80, height=60, K=np.array([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]]), world_to_camera=pose)

    def scene(cameras: list[Camera], points: list[list[float]]) -> Scene:
        return Scene(
            cameras=cameras,
            images=[],
            points=np.array(points),
            colors=np.zeros((len(points), 3), np.uint8),
            up=np.array([0.0, 0.0, 1.0]),
        )

    there = [float(x) for x in range(11)]
    row = [camera([x, -2.0, 1.0], [0.0, 1.0, 0.0]) for x in there + there[::-1]]
    assert find_middle_view(scene(row, [[x, 0.0, 1.0] for x in there])) in (5, 16)  # number 11 shows an end
    turns = [2.0 * np.pi * k / 12 for k in range(12)]
    ring = [camera([np.cos(a), np.sin(a), 0.0], [-np.cos(a), -np.sin(a), 0.0]) for a in turns]
    assert find_middle_view(scene(ring, [[0.0, 0.0, 0.0]])) == 6


def test_cameras_without_photos_are_written_too(counted):
    import dataclasses

    written(dataclasses.replace(counted, scene=dataclasses.replace(counted.scene, images=[])))
    assert bpy.data.collections["Cameras"].objects.keys() == [f"view 00{index}" for index in range(1, 7)]


def test_the_users_own_camera_stays_active(counted):
    own = bpy.data.objects.new("Mine", bpy.data.cameras.new("Mine"))
    bpy.context.scene.collection.objects.link(own)
    bpy.context.scene.camera = own
    written(counted)
    assert bpy.context.scene.camera == own


def test_writing_again_replaces_and_leaves_nothing_behind(counted, counted_with):
    written(counted)
    written(counted_with(label="pear", fruits=2))
    assert bpy.data.collections["Fruits"].objects.keys() == ["pear.001", "pear.002"]
    assert len(bpy.data.collections["Cameras"].objects) == 6
    assert [item.name for item in bpy.data.objects if item.type == "EMPTY"] == ["FruitLangs"]
    assert [mesh.name for mesh in bpy.data.meshes if mesh.users == 0] == []
    assert len(bpy.data.node_groups) == 1
    assert len(bpy.data.materials) == 3


def test_two_blender_scenes_keep_their_own_results(counted):
    written(counted)
    other = bpy.data.scenes.new("Other")
    write_result(other, *counted.parts())
    ours = [item.name for item in bpy.context.scene.objects if "id" in item]
    assert sorted(ours) == ["apple.001", "apple.002", "apple.003"]
    assert sorted(item["id"] for item in other.objects if "id" in item) == [1, 2, 3]


def test_no_fruit_and_no_probability_is_written_too(counted_with):
    counted = counted_with(fruits=0)
    write_result(bpy.context.scene, counted.scene, counted.gaussians, None, counted.fruit_count)
    assert len(bpy.data.collections["Fruits"].objects) == 0
    assert (get_attribute(bpy.data.objects["Gaussians"].data, "probability") == 0).all()


def test_sparse_points_carry_their_linear_colour(counted):
    root = write_root(bpy.context.scene, counted.scene)
    item = write_points(bpy.context.scene, counted.scene, root)
    np.testing.assert_allclose(get_attribute(item.data, "position"), counted.scene.points, atol=1e-6)
    np.testing.assert_allclose(get_attribute(item.data, "radiance:base")[:, :3], 0.5029, atol=1e-3)


def test_a_saved_result_reloads_equal(counted, tmp_path):
    path = tmp_path / "scene.blend"
    write_blend(path, *counted.parts(), asked=join_asked_words(["apple", "plum"], ["leaf"]), set_id="abc")
    assert [file.name for file in tmp_path.iterdir()] == ["scene.blend"]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert bpy.context.scene["fruitlangs_set_id"] == "abc"
    mesh = bpy.data.objects["Gaussians"].data
    np.testing.assert_array_equal(get_attribute(mesh, "probability"), counted.probability)
    assert mesh[ASKED] == "apple, plum | leaf"
    assert bpy.data.objects["apple.003"].parent == bpy.data.objects["FruitLangs"]
    assert bpy.context.scene.camera is not None
    assert [item.type for item in bpy.data.objects].count("LIGHT") == 1


def test_a_saved_result_names_its_photos_relative_to_where_it_will_be(counted_balls, balls, tmp_path):
    out = balls.parent / "balls_fruit"
    path = tmp_path / "staging" / "scene.blend"
    write_blend(path, *(getattr(counted_balls, name) for name in PARTS), folder=out)
    out.mkdir(exist_ok=True)
    shutil.move(path, out / "scene.blend")
    bpy.ops.wm.open_mainfile(filepath=str(out / "scene.blend"))
    item = find_owned_objects(bpy.context.scene, "camera")[0]
    assert item["photo_file"].startswith("//../balls/images/")
    assert photo_path(item).parent == balls / "images"


def test_a_saved_result_opens_in_colour_and_facing_the_tree(counted, tmp_path):
    write_blend(tmp_path / "scene.blend", *counted.parts())
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    areas = [area for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
    assert areas
    assert {area.spaces.active.shading.type for area in areas} == {"MATERIAL"}
    assert areas[0].spaces.active.region_3d.view_distance == pytest.approx(1.3 * 4.0, rel=1e-3)


def test_gaussians_of_the_sky_are_hidden_and_kept(counted):
    import dataclasses

    far = counted.gaussians.means.clone()
    far[0] = 1000.0
    counted = dataclasses.replace(counted, gaussians=dataclasses.replace(counted.gaussians, means=far))
    written(counted)
    evaluated = bpy.context.evaluated_depsgraph_get()
    places = [np.array(one.matrix_world.translation) for one in evaluated.object_instances if one.is_instance]
    assert np.linalg.norm(places, axis=1).max() < 100
    assert len(bpy.data.objects["Gaussians"].data.vertices) == 20


def test_saving_prints_nothing_even_where_stdout_is_a_file(tmp_path):
    script = f"""
import sys
sys.path.insert(0, {str(SCRIPTS)!r})
import _checkout
from pathlib import Path
from fruitlangs.operators.data.write import save_blend
save_blend(Path({str(tmp_path)!r}) / "scene.blend")
print("saved")
"""
    with (tmp_path / "log").open("w") as log:
        subprocess.run([sys.executable, "-c", script], stdout=log, check=True)
    assert (tmp_path / "log").read_text() == "saved\n"


def on_two_trees(counted, *trees):
    """The fruit on these trees, None for none."""
    fruits = [
        dataclasses.replace(fruit, tree=tree) for fruit, tree in zip(counted.fruit_count.fruits, trees, strict=True)
    ]
    return dataclasses.replace(counted, fruit_count=dataclasses.replace(counted.fruit_count, fruits=fruits))


def test_the_fruit_of_each_tree_are_in_a_collection_of_their_own_and_in_that_of_all_fruit(counted):
    written(on_two_trees(counted, 1, 2, None))
    held = {each.name: [item.name for item in each.objects] for each in bpy.data.collections}
    assert (held["Tree 1"], held["Tree 2"]) == (["apple.001"], ["apple.002"])
    assert len(held["Fruits"]) == 3
    written(on_two_trees(counted, 2, 2, 2))
    assert len(bpy.data.collections["Tree 2"].objects) == 3
    assert "Tree 1" not in bpy.data.collections
    written(counted)
    assert not [each.name for each in bpy.data.collections if each.name.startswith("Tree")]


def test_fruit_are_coloured_by_label_tree_or_probability(counted, extension):
    written(on_two_trees(counted, 1, 1, 2))
    look, items = bpy.context.scene.fruitlangs.look, [bpy.data.objects[f"apple.00{k}"] for k in (1, 2, 3)]

    def colors():
        return [tuple(np.round(item.color, 4)) for item in items]

    by_label = colors()
    look.fruit = "TREE"
    one, same, other = colors()
    assert one == same != other
    look.fruit = "PROBABILITY"
    assert len(set(colors())) == 1  # all have .9
    assert colors()[0] not in (one, other)
    look.fruit = "LABEL"
    assert colors() == by_label


def test_every_fruit_the_encoder_knows_has_a_hue_of_its_own():
    assert set(LABEL_HUES) == {*FRUITS, "fruit"}


def test_an_unwritable_place_is_an_error_and_leaves_the_old_file(counted, tmp_path):
    blocked = tmp_path / "scene.blend"
    blocked.mkdir()
    with pytest.raises(OutputError, match=r"scene\.blend cannot be written"):
        save_blend(blocked)
    assert list(tmp_path.iterdir()) == [blocked]


def test_a_blend_is_replaced_without_a_backup(counted, tmp_path):
    path = tmp_path / "scene.blend"
    write_blend(path, *counted.parts())
    write_blend(path, *counted.parts())
    assert [file.name for file in tmp_path.iterdir()] == ["scene.blend"]
