"""Tools that use clicks: scale, ground, region. The clicks themselves are driven in a window."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from fruitlangs.engine.counting.regions.region import region_of
from fruitlangs.engine.errors import ConfigError
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects
from fruitlangs.operators.data.write_root import write_root
from fruitlangs.operators.scene_frame import scene_frame
from fruitlangs.operators.settings.region import limit_to_region
from fruitlangs.operators.settings.settings import read_config
from fruitlangs.operators.steps.show_result import show_result
from fruitlangs.operators.tools.level import find_plane_up

UP = np.array([0.0, -0.8, 0.6])


@pytest.fixture
def shown(extension, counted, result_of, tmp_path):
    """A count without a scale, shown in an empty file."""
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    return bpy.context.scene


def test_a_measured_length_makes_millimetres_at_once_and_is_in_the_settings(shown):
    assert bpy.ops.fruitlangs.set_length(points=(1, 2, 3, 1, 2, 5), length=0.5) == {"FINISHED"}
    root = find_owned_object(shown, "root")
    assert root["metres_per_unit"] == pytest.approx(0.25)
    assert root.matrix_basis.to_scale()[0] == pytest.approx(0.25)
    first = find_owned_objects(shown, "fruit")[0]
    assert first["diameter"] == pytest.approx(0.1 * 0.25)
    assert (shown.fruitlangs.result.unit, shown.fruitlangs.result.mean_diameter) == ("mm", pytest.approx(50.0))
    units = read_config(shown.fruitlangs).units
    assert (units.points, units.length) == ((1.0, 2.0, 3.0, 1.0, 2.0, 5.0), 0.5)


def test_a_length_measured_again_replaces_the_first(shown):
    for _ in range(2):
        bpy.ops.fruitlangs.set_length(points=(1, 2, 3, 1, 2, 5), length=0.5)
    bpy.ops.fruitlangs.set_length(points=(0, 0, 0, 0, 0, 1), length=0.1)
    assert find_owned_objects(shown, "fruit")[0]["diameter"] == pytest.approx(0.01)
    assert find_owned_object(shown, "root").matrix_basis.to_scale()[0] == pytest.approx(0.1)
    assert shown.fruitlangs.result.mean_diameter == pytest.approx(20.0)


def test_a_measured_scale_is_what_writing_at_that_scale_shows(shown, counted):
    bpy.ops.fruitlangs.set_length(points=(1, 2, 3, 1, 2, 5), length=0.5)
    shown_matrix = find_owned_object(shown, "root").matrix_basis.copy()
    write_root(shown, dataclasses.replace(counted.scene, metres_per_unit=0.25))
    np.testing.assert_allclose(find_owned_object(shown, "root").matrix_basis, shown_matrix, atol=1e-6)


def test_two_ends_in_one_place_are_an_error(shown):
    with pytest.raises(RuntimeError, match="Both points are the same"):
        bpy.ops.fruitlangs.set_length(points=(1, 2, 3, 1, 2, 3), length=0.5)
    assert find_owned_object(shown, "root")["metres_per_unit"] == 0.0


def test_three_places_on_the_ground_make_it_level_at_height_0(shown):
    places = [Vector((0.0, 1.0, 0.2)), Vector((2.0, 1.0, 0.3)), Vector((0.0, 3.0, 0.1))]
    flat = [coordinate for place in places for coordinate in place]
    assert bpy.ops.fruitlangs.set_ground(points=flat) == {"FINISHED"}
    root = find_owned_object(shown, "root")
    np.testing.assert_allclose([(root.matrix_basis @ place).z for place in places], 0.0, atol=1e-5)
    up = np.array(read_config(shown.fruitlangs).scene.up)
    np.testing.assert_allclose(np.array(root.matrix_basis.to_3x3()) @ up, [0, 0, 1], atol=1e-5)


def test_a_picked_ground_stays_when_the_scene_is_written_again(shown, counted):
    flat = [0.0, 1.0, 0.2, 2.0, 1.0, 0.3, 0.0, 3.0, 0.1]
    bpy.ops.fruitlangs.set_ground(points=flat)
    up = np.array(read_config(shown.fruitlangs).scene.up)
    root = write_root(shown, dataclasses.replace(counted.scene, up=up))
    assert (root.matrix_basis @ Vector(np.reshape(flat, (3, 3)).mean(0).tolist())).z == pytest.approx(0.0, abs=1e-5)


def test_up_is_on_the_side_of_the_cameras_and_a_line_gives_none():
    ground = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_allclose(find_plane_up(ground, np.array([0.3, 0.3, 5.0])), [0, 0, 1])
    np.testing.assert_allclose(find_plane_up(ground, np.array([0.3, 0.3, -5.0])), [0, 0, -1])
    assert find_plane_up(np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2.01]]), np.zeros(3)) is None


def test_three_places_in_a_line_are_an_error(shown):
    with pytest.raises(RuntimeError, match="lie on a line"):
        bpy.ops.fruitlangs.set_ground(points=(0, 0, 0, 1, 0, 0, 2, 0, 0))


def test_a_region_box_holds_all_fruit_at_first(shown, counted):
    assert bpy.ops.fruitlangs.add_region() == {"FINISHED"}
    region = region_of(read_config(shown.fruitlangs).count, UP)
    assert region.contains(counted.fruit_count.centers).all()
    assert not bpy.ops.fruitlangs.add_region.poll()


def test_a_moved_turned_and_scaled_box_is_the_region_that_is_counted(shown):
    bpy.ops.fruitlangs.add_region()
    box, root = find_owned_object(shown, "region"), find_owned_object(shown, "root")
    world = Matrix.LocRotScale((0.4, -0.2, 1.0), Matrix.Rotation(0.7, 3, "Z"), (0.5, 0.2, 0.3))
    box.matrix_basis = world
    region = region_of(read_config(shown.fruitlangs).count, UP)
    local = np.random.default_rng(0).uniform(-2.0, 2.0, (500, 3))
    scene = np.array([root.matrix_basis.inverted() @ (world @ Vector(place)) for place in local.tolist()])
    np.testing.assert_array_equal(region.contains(scene), (np.abs(local) <= 1.0).all(axis=1))


def test_a_tilted_or_flat_box_is_an_error_that_says_what_to_do(shown):
    bpy.ops.fruitlangs.add_region()
    box = find_owned_object(shown, "region")
    box.rotation_euler.x = 0.3
    with pytest.raises(ConfigError, match="tilted"):
        read_config(shown.fruitlangs)
    box.rotation_euler.x = 0.0  # as the message says
    read_config(shown.fruitlangs)
    box.scale.z = 0.0
    with pytest.raises(ConfigError, match="flat"):
        read_config(shown.fruitlangs)


def test_a_box_stays_upright_where_it_is_in_the_scene_when_the_ground_is_set(shown):
    bpy.ops.fruitlangs.add_region()
    box = find_owned_object(shown, "region")
    box.rotation_euler.z = 0.4
    before = scene_frame(shown).of(box)
    bpy.ops.fruitlangs.set_ground(points=(0.0, 1.0, 0.2, 2.0, 1.0, 0.5, 0.0, 3.0, 0.1))
    after = scene_frame(shown).of(box)
    np.testing.assert_allclose(after.translation, before.translation, atol=1e-5)
    np.testing.assert_allclose(after.to_scale(), before.to_scale(), rtol=1e-5)
    assert read_config(shown.fruitlangs).count.polygon is not None


def test_without_the_box_counts_are_everywhere_again(shown):
    bpy.ops.fruitlangs.add_region()
    assert bpy.ops.fruitlangs.remove_region() == {"FINISHED"}
    config = read_config(shown.fruitlangs).count
    assert (config.polygon, config.heights) == (None, None)
    assert limit_to_region(shown, config) == config
