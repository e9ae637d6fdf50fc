"""Splats without a graphics card: values, order, and the look that drives the Geometry Nodes."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from blender_examples import drawn, imported, written
from mathutils import Matrix

import fruitlangs
from fruitlangs.fruitlangs_addon.panels.appearance_panel import FRUITLANGS_PT_look
from fruitlangs.fruitlangs_addon.panels.step_reconstruct import FRUITLANGS_PT_reconstruct
from fruitlangs.operators.blender_data import find_owned_object, linear_from_srgb, set_attribute
from fruitlangs.operators.drawing import splat_drawing
from fruitlangs.operators.drawing.splat_order import find_near_distance, has_turned, select_shown, sort_back_to_front
from fruitlangs.operators.viewport import appearance
from fruitlangs.operators.viewport.gaussian_nodes import PROBABILITY_RAMP, get_input, set_input
from fruitlangs.operators.viewport.splats import POINT_SIGMA, pack_covariances, splats_in_training, splats_of_mesh


def full(packed):
    """(N, 3, 3) of (N, 6)."""
    return packed[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def test_covariances_are_the_engines(counted):
    packed = pack_covariances(counted.gaussians.scales.numpy(), counted.gaussians.quats.numpy())
    np.testing.assert_allclose(full(packed), counted.gaussians.covariances.numpy(), rtol=1e-4, atol=1e-9)


def test_ellipses_are_those_of_the_engines_reference(counted):
    """What the vertex shader does, in NumPy: J from rows of the projection matrix, Blender's axes."""
    from dataclasses import replace

    from fruitlangs.engine.splatting.rendering.reference import _ellipses
    from fruitlangs.operators.data.write_cameras import blender_pose

    camera, gaussians = counted.scene.cameras[2], counted.gaussians
    gaussians = replace(gaussians, means=gaussians.means + 0.5)
    double = replace(
        gaussians,
        **{
            name: getattr(gaussians, name).double() for name in ("means", "log_scales", "quats", "opacity_logits", "sh")
        },
    )
    means, covariances, _ = _ellipses(double, camera)

    (fx, _, cx), (_, fy, cy), _ = camera.K
    width, height = camera.width, camera.height
    projection = np.array(
        [
            [2 * fx / width, 0, 1 - 2 * cx / width, 0],
            [0, 2 * fy / height, 2 * cy / height - 1, 0],
            [0, 0, -1.0, -0.02],
            [0, 0, -1, 0],
        ]
    )
    view = np.linalg.inv(blender_pose(camera))
    packed = full(pack_covariances(gaussians.scales.numpy(), gaussians.quats.numpy()))
    for mean, covariance, wanted_mean, wanted in zip(
        gaussians.means.numpy(), packed, means.numpy(), covariances.numpy(), strict=True
    ):
        clip = projection @ view @ [*mean, 1.0]
        screen = clip[:2] / clip[3]
        held = np.clip(screen, -1.3, 1.3)
        rows = [
            0.5 * size / clip[3] * (projection[axis, :3] - held[axis] * projection[3, :3])
            for axis, size in enumerate((width, height))
        ]
        spread = np.array(rows) @ view[:3, :3]
        found = spread @ covariance @ spread.T + 0.3 * np.eye(2)
        flip = np.diag([1.0, -1.0])  # Blender's pictures count rows from below
        np.testing.assert_allclose(flip @ found @ flip, wanted, rtol=1e-3, atol=1e-3)
        pixel = (screen * 0.5 + 0.5) * (width, height)
        np.testing.assert_allclose((pixel[0], height - pixel[1]), wanted_mean, rtol=1e-4, atol=1e-3)


def test_splats_hold_what_the_mesh_holds(counted):
    splats = splats_of_mesh(written(counted).data)
    np.testing.assert_array_equal(splats.means, counted.gaussians.means.numpy())
    np.testing.assert_array_equal(splats.probability, counted.probability.numpy())
    np.testing.assert_allclose(splats.opacities, counted.gaussians.opacities.numpy())
    np.testing.assert_allclose(full(splats.covariances), counted.gaussians.covariances.numpy(), rtol=1e-4, atol=1e-9)
    assert not splats.antialiased


def test_splats_of_antialiased_gaussians_are_antialiased(counted):
    from dataclasses import replace

    from fruitlangs.operators.data.write_gaussians import make_gaussian_mesh

    assert splats_of_mesh(make_gaussian_mesh(replace(counted.gaussians, antialiased=True), None, ())).antialiased


def test_no_splats_of_a_mesh_that_is_edited_or_foreign(counted):
    item = written(counted)
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    assert splats_of_mesh(item.data) is None
    bpy.ops.object.mode_set(mode="OBJECT")
    assert splats_of_mesh(item.data) is not None
    assert splats_of_mesh(bpy.data.meshes.new("foreign")) is None


def test_splats_without_an_answer_have_no_probability(counted):
    assert splats_of_mesh(written(counted, probability=False).data).probability is None


def test_splats_in_training_have_the_colours_of_the_mesh(counted):
    given = counted.gaussians
    arrays = (given.means, given.scales, given.quats, given.base_colors, given.opacities)
    splats = splats_in_training(*(values.numpy() for values in arrays), False)
    kept = splats_of_mesh(written(counted).data)
    np.testing.assert_allclose(splats.colors, kept.colors, atol=1e-6)
    np.testing.assert_allclose(splats.covariances, kept.covariances, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("count", [0, 1, 2, 5000])
def test_order_is_from_the_farthest_to_the_nearest(count):
    random = np.random.default_rng(count)
    means, towards = random.normal(size=(count, 3)).astype(np.float32), random.normal(size=3)
    order = sort_back_to_front(means, towards)
    assert sorted(order) == list(range(count))
    depth = (means @ towards.astype(np.float32))[order].astype(float)
    assert np.all(np.diff(depth) >= -1e-9 * (np.ptp(depth) if count else 0))


def test_order_holds_where_one_is_very_far(counted):
    depth = np.array([3.0, 1.0, 1.0001, -1e4], np.float32)
    means = np.stack([np.zeros(4), np.zeros(4), depth], 1).astype(np.float32)
    assert sort_back_to_front(means, (0, 0, 1)).tolist() == [3, 1, 2, 0]


def test_equal_depths_keep_their_order():
    assert sort_back_to_front(np.ones((4, 3), np.float32), (0, 0, 1)).tolist() == [0, 1, 2, 3]


def test_only_turning_calls_for_another_order():
    assert not has_turned((0, 0, 1), (0, 0, 2))
    assert not has_turned((0, 0, 1), (0, 0.001, 1))
    assert has_turned((0, 0, 1), (0, 0.01, 1))
    assert has_turned((0, 0, 1), (0, 0, -1))


def test_far_faint_and_broken_splats_are_not_shown():
    means = np.array([[0, 0, 0], [3, 0, 0], [1, 0, 0], [np.nan, 0, 0]], np.float32)
    opacities = np.array([0.5, 0.5, 0.003, 0.5], np.float32)
    assert select_shown(means, opacities, (0.0, 0.0, 0.0), 2.0).tolist() == [0]
    assert select_shown(means, opacities, (2.0, 0.0, 0.0), 1e9).tolist() == [0, 1]


@pytest.mark.parametrize("size", [0.01, 1.0, 300.0])
def test_the_near_distance_is_the_engines_near_plane(counted, size):
    from dataclasses import replace

    from fruitlangs.engine.splatting.rendering.render import near_plane

    camera = counted.scene.cameras[0]
    means = size * np.random.default_rng(0).normal(size=(23_000, 3)).astype(np.float32)
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= size
    moved = replace(camera, world_to_camera=pose)
    assert find_near_distance(means, moved.center.astype(np.float32)) == near_plane(means, moved)
    assert find_near_distance(means[:0], (0, 0, 0)) > 0


def test_the_shaders_ramp_is_the_one_of_the_nodes():
    from fruitlangs.operators.drawing.splat_shader import ramp_source

    source = ramp_source()
    assert source.count("mix(") == len(PROBABILITY_RAMP) - 1
    for (low, *_), (high, *_) in itertools.pairwise(PROBABILITY_RAMP):
        assert f"(at - {low:.6f}) / {high - low:.6f}" in source


def shown(name):
    """Attribute `name` of the points that Geometry Nodes make, in the order of the mesh; [] where they make none."""
    item = find_owned_object(bpy.context.scene, "gaussians")
    set_input(item.modifiers[0], "Ellipsoids up to", 0)
    for other in ("Lowest Opacity", "Lowest Probability"):
        set_input(item.modifiers[0], other, 0.0)
    set_input(item.modifiers[0], "Reach", 1e9)
    item.update_tag()
    bpy.context.view_layer.update()
    evaluated = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if not hasattr(evaluated, "evaluated_geometry"):
        pytest.skip("this Blender shows no script what Geometry Nodes make; 4.5 and later do")
    geometry = evaluated.evaluated_geometry()
    cloud = geometry.pointcloud
    if cloud is None or not len(cloud.points):
        return np.zeros(0)
    values = np.empty(len(cloud.points), np.float32)
    cloud.attributes[name].data.foreach_get("value", values)
    return values


def test_threshold_and_dimming_reach_the_nodes(extension, counted):
    settings = bpy.context.scene.fruitlangs
    written(counted)
    settings.config.count.threshold, settings.look.dimming = 0.6, 0.25
    probability = counted.probability.numpy()
    fits = probability >= np.float32(0.6)
    place = np.where(fits, 0.5 + 0.5 * (probability - 0.6) / 0.4, 0.0)
    np.testing.assert_allclose(shown("ramp"), place, atol=1e-5)
    np.testing.assert_allclose(shown("brightness"), np.where(fits, 1.0, 0.75), atol=1e-6)
    settings.look.highlight = False
    assert not shown("ramp").any()
    assert (shown("brightness") == 1).all()


def test_nothing_is_dimmed_before_a_prompt_is_answered(extension, counted):
    from fruitlangs.operators.steps.ask import show_answer

    item = written(counted, probability=False)
    appearance.apply_appearance(bpy.context.scene)
    assert not get_input(item.modifiers[0], "Highlight")
    show_answer(bpy.context.scene, counted.probability.numpy(), "apple | ")
    assert get_input(item.modifiers[0], "Highlight")


def test_viewports_show_no_ellipsoids_where_nothing_is_to_be_shown(extension, counted):
    written(counted)
    settings = bpy.context.scene.fruitlangs
    settings.look.style = "NONE"
    assert len(shown("ramp")) == 0
    settings.look.style = "ELLIPSOIDS"
    assert len(shown("ramp")) == 20


def test_background_mode_keeps_ellipsoids_for_there_are_no_splats(extension, counted):
    item = written(counted)
    assert bpy.context.scene.fruitlangs.look.style == "SPLATS"
    appearance.apply_appearance(bpy.context.scene)
    assert get_input(item.modifiers[0], "In Viewport")


def test_a_window_hides_ellipsoids_but_not_in_the_file_on_disk(extension, counted, monkeypatch, tmp_path):
    item = written(counted)
    monkeypatch.setattr(appearance, "has_window", lambda: True)
    appearance.apply_appearance(bpy.context.scene)
    assert not get_input(item.modifiers[0], "In Viewport")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert not get_input(item.modifiers[0], "In Viewport")
    monkeypatch.setattr(appearance, "apply_appearances", lambda *_: None)
    bpy.app.handlers.load_post[:] = [
        item for item in bpy.app.handlers.load_post if item.__name__ != "apply_appearances"
    ]
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert get_input(find_owned_object(bpy.context.scene, "gaussians").modifiers[0], "In Viewport")


def test_a_window_draws_sparse_points_as_splats_and_the_file_has_points(extension, counted, monkeypatch, tmp_path):
    item = imported(counted)
    appearance.apply_appearance(bpy.context.scene)
    assert get_input(item.modifiers[0], "In Viewport")
    monkeypatch.setattr(appearance, "has_window", lambda: True)
    appearance.apply_appearance(bpy.context.scene)
    assert not get_input(item.modifiers[0], "In Viewport")
    for style in ("ELLIPSOIDS", "NONE"):
        bpy.context.scene.fruitlangs.look.style = style
        assert get_input(item.modifiers[0], "In Viewport")
    bpy.context.scene.fruitlangs.look.style = "SPLATS"
    appearance.show_ellipsoids()
    assert get_input(item.modifiers[0], "In Viewport")


def test_sparse_points_are_round_splats_of_their_colour(counted):
    item = imported(counted)
    set_input(item.modifiers[0], "Radius", 0.25)
    splats = splat_drawing._read(item)
    assert len(splats) == len(counted.scene.points) > 0
    np.testing.assert_allclose(splats.means, counted.scene.points, rtol=1e-6)
    sigma = POINT_SIGMA * 0.25
    np.testing.assert_allclose(full(splats.covariances), np.tile(sigma**2 * np.eye(3), (len(splats), 1, 1)), rtol=1e-6)
    np.testing.assert_allclose(splats.colors, linear_from_srgb(counted.scene.colors / 255.0), atol=1e-6)
    assert splats.probability is None


@pytest.fixture
def changes(monkeypatch):
    """What is to be read again after an object was moved, which asks for nothing, and then changed by a function."""

    def changes(item, change) -> set[int]:
        bpy.context.view_layer.update()
        monkeypatch.setattr(splat_drawing, "_drawn", splat_drawing.Drawn())
        bpy.app.handlers.depsgraph_update_post.append(splat_drawing.note_changes)
        try:
            item.location.x = 3.0
            bpy.context.view_layer.update()
            assert not splat_drawing._drawn.stale
            change()
            bpy.context.view_layer.update()
        finally:
            bpy.app.handlers.depsgraph_update_post.remove(splat_drawing.note_changes)
        return splat_drawing._drawn.stale

    return changes


def test_sparse_points_are_read_again_when_their_radius_changed(changes, counted):
    item = imported(counted)

    def widen():
        set_input(item.modifiers[0], "Radius", 0.5)
        item.update_tag()

    assert changes(item, widen) == {item.data.session_uid}


def test_nodes_of_sparse_points_of_an_older_version_are_renewed(extension, counted):
    item = imported(counted)
    old = item.modifiers[0].node_group.copy()
    old["fruitlangs"] = "point nodes 1"
    old.interface.remove(old.interface.items_tree["In Viewport"])
    item.modifiers[0].node_group = old
    set_input(item.modifiers[0], "Radius", 0.5)
    appearance.apply_appearance(bpy.context.scene)
    assert item.modifiers[0].node_group != old
    assert get_input(item.modifiers[0], "Radius") == 0.5
    assert get_input(item.modifiers[0], "In Viewport")


def test_nodes_of_an_older_version_are_renewed_and_keep_their_inputs(extension, counted):
    item = written(counted)
    old = item.modifiers[0].node_group.copy()
    old["fruitlangs"] = "gaussian nodes 1"
    for name in ("Highlight", "Threshold", "Dimming", "In Viewport"):
        old.interface.remove(old.interface.items_tree[name])
    item.modifiers[0].node_group = old
    set_input(item.modifiers[0], "Reach", 7.5)
    appearance.apply_appearance(bpy.context.scene)
    assert item.modifiers[0].node_group != old
    assert get_input(item.modifiers[0], "Reach") == 7.5
    assert get_input(item.modifiers[0], "Highlight")


def test_a_changed_mesh_is_read_again_and_a_moved_object_is_not(changes, counted):
    item = written(counted)

    def answer():
        set_attribute(item.data, "probability", "FLOAT", np.ones(20, np.float32))
        item.data.update()

    assert changes(item, answer) == {item.data.session_uid}


def test_what_has_the_gaussians_role_and_is_no_mesh_is_left_alone(extension, counted):
    """As if the user converted the Gaussians to a point cloud."""
    bpy.data.objects.remove(written(counted))
    item = bpy.data.objects.new("Gaussians", None)
    item["fruitlangs"] = "gaussians"
    bpy.context.scene.collection.objects.link(item)
    assert find_owned_object(bpy.context.scene, "gaussians") is None
    appearance.apply_appearance(bpy.context.scene)


@pytest.fixture
def card(extension, counted, monkeypatch):
    """In place of a viewport and its card: calls of the drawing, and what it raises."""
    written(counted)
    calls = SimpleNamespace(count=0, error=RuntimeError("no such shader"), timers=[])

    def layers(*_):
        calls.count += 1
        if calls.error:
            raise calls.error
        return []

    timers = SimpleNamespace(register=lambda function, first_interval: calls.timers.append(function))
    context = SimpleNamespace(
        region=object(), region_data=object(), space_data=None, scene=bpy.context.scene, view_layer=None
    )
    blender = SimpleNamespace(context=context, app=SimpleNamespace(timers=timers), types=bpy.types)
    monkeypatch.setattr(splat_drawing, "bpy", blender)
    monkeypatch.setattr(splat_drawing, "_collect_layers", layers)
    monkeypatch.setattr(splat_drawing, "_drawn", splat_drawing.Drawn())
    return calls


def test_why_splats_cannot_be_drawn_stands_in_the_panels_with_a_way_to_ellipsoids(card):
    for panel in (FRUITLANGS_PT_look, FRUITLANGS_PT_reconstruct):
        assert "cannot be drawn" not in drawn(panel).text
    splat_drawing.draw_viewport()
    splat_drawing.draw_viewport()
    assert (card.count, len(card.timers)) == (1, 1)
    for panel in (FRUITLANGS_PT_look, FRUITLANGS_PT_reconstruct):
        assert "Splats cannot be drawn here (RuntimeError: no such shader)" in drawn(panel).text
        assert ("style", "ELLIPSOIDS") in drawn(panel).buttons


def test_another_look_tries_to_draw_splats_again(card):
    splat_drawing.draw_viewport()
    card.error = None
    bpy.context.scene.fruitlangs.look.style = "ELLIPSOIDS"
    splat_drawing.draw_viewport()
    assert card.count == 2
    assert splat_drawing.explain_problem() == ""
    assert "cannot be drawn" not in drawn(FRUITLANGS_PT_look).text


def test_handlers_come_once_and_go():
    before = {name: list(getattr(bpy.app.handlers, name)) for name in {**appearance.HANDLERS, **splat_drawing.HANDLERS}}
    fruitlangs.register()
    fruitlangs.register()
    for name, function in appearance.HANDLERS.items():
        assert getattr(bpy.app.handlers, name).count(function) == 1
    fruitlangs.unregister()
    assert {name: list(getattr(bpy.app.handlers, name)) for name in before} == before


def test_background_mode_draws_nothing_and_never_loads_the_gpu_module(extension, counted):
    import sys

    splats = splats_of_mesh(written(counted).data)
    preview = splat_drawing.Interim(splats, Matrix.Identity(4), (0.0, 0.0, 0.0), 1.0)
    splat_drawing.show_preview(bpy.context.scene.session_uid, preview)
    assert not splat_drawing._drawn.previews
    assert not [name for name in sys.modules if name.endswith("operators.splat_textures")]


def test_what_splats_share_fits_the_shaders_struct():
    from fruitlangs.operators.drawing.splat_shader import pack_values

    model_view = Matrix.Translation((1.0, 2.0, 3.0))
    values = pack_values(
        model_view,
        Matrix.Identity(4),
        (640, 480),
        nearest=0.1,
        threshold=0.5,
        dimming=0.65,
        highlight=True,
        antialiased=False,
        row=4096,
    )
    assert values.dtype == np.float32
    assert values[12:15].tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(values[32:], [640, 480, 0.1, 0.5, 0.65, 1, 0, 4096])
