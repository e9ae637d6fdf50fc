"""What a .blend holds comes back as the engine's values."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fruitlangs.engine.errors import CountingError, FormatError, SceneError
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, linear_from_srgb, srgb_from_linear
from fruitlangs.operators.data.read_cameras import read_active_camera, read_scene
from fruitlangs.operators.data.read_fruits import read_fruits
from fruitlangs.operators.data.read_gaussians import read_gaussians
from fruitlangs.operators.steps.show_result import show_result, show_scene


@pytest.fixture
def shown(extension, counted_with, result_of, tmp_path):
    """Three apples in a scene of which a unit is 2 m."""
    counted = counted_with(metres_per_unit=2.0)
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    return counted


def fruit(number):
    return next(item for item in find_owned_objects(bpy.context.scene, "fruit") if item["id"] == number)


def test_fruit_come_back_as_they_were_counted(shown):
    found = read_fruits(bpy.context.scene)
    assert found.count == 3
    for old, new in zip(shown.fruit_count.fruits, found.fruits, strict=True):
        assert (new.id, new.label, new.views, new.kind) == (old.id, old.label, old.views, old.kind)
        assert (new.visible_fraction, new.fallen, new.tree) == (old.visible_fraction, old.fallen, old.tree)
        assert new.probability == pytest.approx(old.probability)
        np.testing.assert_allclose(new.center, old.center, atol=1e-6)
        np.testing.assert_allclose([new.diameter, new.diameter_sd], [old.diameter, old.diameter_sd], rtol=1e-5)
        np.testing.assert_allclose(new.axes.T @ new.axes, old.axes.T @ old.axes, atol=1e-6)
        np.testing.assert_array_equal(new.color, old.color)
        np.testing.assert_array_equal(new.members, old.members)
    assert found.max_probability == pytest.approx(1.0)
    assert found.mean_diameter == pytest.approx(0.2)


def test_a_fruit_that_the_user_moved_and_scaled_is_read_as_it_stands(shown):
    fruit(2).location.x = 9.0
    fruit(2).scale *= 1.5
    found = read_fruits(bpy.context.scene).fruits[1]
    assert found.center[0] == pytest.approx(9.0)
    assert found.diameter == pytest.approx(0.3)
    assert found.volume == pytest.approx(np.pi / 6.0 * 0.3**3, rel=1e-5)
    assert np.isnan(found.diameter_sd)


def test_rejected_fruit_are_left_out_and_the_interval_is_the_corrected_one(shown):
    bpy.context.scene.fruitlangs.result.low, bpy.context.scene.fruitlangs.result.high = 2, 5
    assert read_fruits(bpy.context.scene).interval == (2, 5)
    fruit(2).select_set(True)
    bpy.ops.fruitlangs.reject_fruit()
    found = read_fruits(bpy.context.scene)
    assert [each.id for each in found.fruits] == [1, 3]
    assert found.interval is not None
    assert found.interval[1] == 4


def test_the_estimate_with_hidden_fruit_holds_until_a_review(shown):
    told = bpy.context.scene.fruitlangs.result
    told.total, told.total_low, told.total_high = 4.5, 3, 6
    assert read_fruits(bpy.context.scene).total_interval == (3, 6)
    fruit(1)["review"] = "confirmed"
    assert read_fruits(bpy.context.scene).total is None


def test_a_copy_of_a_fruit_has_a_number_of_its_own(shown):
    copy = fruit(2).copy()
    bpy.data.collections["Fruits"].objects.link(copy)
    assert [each.id for each in read_fruits(bpy.context.scene).fruits] == [1, 2, 4, 3]


def test_trees_are_reported_by_their_fruit(shown):
    fruit(1)["tree"], fruit(3)["tree"] = 2, 2
    (tree,) = read_fruits(bpy.context.scene).trees
    assert (tree.number, tree.count) == (2, 2)


def test_before_a_count_there_are_no_fruit_to_read(extension):
    with pytest.raises(CountingError, match="Count first"):
        read_fruits(bpy.context.scene)


def test_gaussians_come_back_with_their_mean_colour(shown):
    found, old = read_gaussians(bpy.context.scene).gaussians(), shown.gaussians
    np.testing.assert_allclose(found.means, old.means, atol=1e-6)
    np.testing.assert_allclose(found.scales, old.scales, rtol=1e-5)
    np.testing.assert_allclose(found.rotations, old.rotations, atol=1e-5)
    np.testing.assert_allclose(found.opacities, old.opacities, atol=1e-6)
    np.testing.assert_allclose(found.base_colors, old.base_colors, atol=1e-5)
    assert found.sh_degree == 0
    assert not found.antialiased


def test_gaussians_that_lost_an_attribute_say_which(shown):
    mesh = find_owned_object(bpy.context.scene, "gaussians").data
    mesh.attributes.remove(mesh.attributes["opacity"])
    with pytest.raises(FormatError, match="'opacity'"):
        read_gaussians(bpy.context.scene)


def test_a_scene_without_gaussians_has_none_to_read(extension):
    assert read_gaussians(bpy.context.scene) is None


def test_srgb_comes_back_from_linear_colour():
    values = np.linspace(0.0, 1.0, 101, dtype=np.float32)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)


def test_cameras_come_back_with_their_photos_sizes(shown):
    scene = read_scene(bpy.context.scene)
    assert scene.metres_per_unit == pytest.approx(2.0)
    np.testing.assert_allclose(scene.up, shown.scene.up, atol=1e-6)
    for old, new in zip(shown.scene.cameras, scene.cameras, strict=True):
        assert (new.width, new.height) == (old.width, old.height)
        np.testing.assert_allclose(new.K, old.K, rtol=1e-5)
        np.testing.assert_allclose(new.world_to_camera, old.world_to_camera, atol=1e-5)


def test_sparse_points_come_back(extension, counted):
    show_scene(bpy.context, bpy.context.scene, counted.scene)
    scene = read_scene(bpy.context.scene)
    np.testing.assert_allclose(scene.points, counted.scene.points, atol=1e-6)
    np.testing.assert_array_equal(scene.colors, counted.scene.colors)


@pytest.mark.parametrize("fit", ["AUTO", "HORIZONTAL", "VERTICAL"])
@pytest.mark.parametrize("size", [(300, 200), (200, 300)])
def test_a_camera_of_the_users_own_sees_what_blender_sees_through_it(shown, fit, size):
    bpy_scene = bpy.context.scene
    own = bpy.data.objects.new("Mine", bpy.data.cameras.new("Mine"))
    bpy_scene.collection.objects.link(own)
    own.matrix_world = Matrix.Translation((1.0, -7.0, 2.0)) @ Matrix.Rotation(1.3, 4, "X")
    own.data.sensor_fit, own.data.lens, own.data.shift_x, own.data.shift_y = fit, 41.0, 0.05, -0.1
    bpy_scene.camera = own
    bpy_scene.render.resolution_x, bpy_scene.render.resolution_y = size
    bpy_scene.render.pixel_aspect_x, bpy_scene.render.pixel_aspect_y = 1.0, 1.25
    camera = read_active_camera(bpy_scene)
    bpy_scene.render.resolution_percentage = 50
    assert read_active_camera(bpy_scene).width == size[0] // 2
    clip = own.calc_matrix_camera(
        bpy.context.evaluated_depsgraph_get(), x=size[0], y=size[1], scale_x=1.0, scale_y=1.25
    )
    point = np.array(find_owned_object(bpy_scene, "root").matrix_world.inverted() @ Matrix.Translation((0.3, 0.4, 1.0)))
    drawn = clip @ own.matrix_world.inverted() @ Matrix.Translation((0.3, 0.4, 1.0)).col[3]
    pixel, depth = camera.project(point[:3, 3])
    assert depth > 0
    expected = (0.5 * (1 + drawn.x / drawn.w) * size[0], 0.5 * (1 - drawn.y / drawn.w) * size[1])
    np.testing.assert_allclose(pixel, expected, atol=1e-2)


def test_a_camera_without_perspective_is_refused_in_words(shown):
    bpy.context.scene.camera.data.type = "ORTHO"
    with pytest.raises(SceneError, match="Perspective"):
        read_active_camera(bpy.context.scene)


def test_a_scene_without_an_active_camera_says_so(shown):
    bpy.context.scene.camera = None
    with pytest.raises(SceneError, match="no active camera"):
        read_active_camera(bpy.context.scene)
