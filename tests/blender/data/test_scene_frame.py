"""Blender's Apply Transform, parenting and the like change no number of the count."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from fruitlangs.engine.errors import CountingError, SceneError
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, point_positions
from fruitlangs.operators.data.fruit_objects import read_log
from fruitlangs.operators.data.read_cameras import read_cameras, read_up
from fruitlangs.operators.data.read_fruits import read_fruits
from fruitlangs.operators.data.stored_review import keep_corrections
from fruitlangs.operators.scene_frame import scene_frame
from fruitlangs.operators.steps.show_result import show_result

REMEDY = "import the result again"


@pytest.fixture
def shown(extension, counted_with, result_of, tmp_path):
    """Three apples, of diameters .1, .2 and .3, in a scene of which a unit is .25 m."""
    counted = counted_with(metres_per_unit=0.25)
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    return bpy.context.scene


def fruit(number: int) -> bpy.types.Object:
    return next(item for item in find_owned_objects(bpy.context.scene, "fruit") if item["id"] == number)


def select(*items: bpy.types.Object) -> None:
    for item in bpy.context.scene.objects:
        item.select_set(item in items)
    bpy.context.view_layer.objects.active = items[0]


def ours(scene) -> list[bpy.types.Object]:
    """Everything below the root."""
    return [item for role in ("gaussians", "camera", "fruit") for item in find_owned_objects(scene, role)]


def apply_to_root(scene, **options: bool) -> None:
    select(find_owned_object(scene, "root"))
    assert bpy.ops.object.transform_apply(**options) == {"FINISHED"}


def apply_to_fruit(scene, *numbers: int) -> None:
    select(*(fruit(number) for number in numbers))
    bpy.ops.object.make_single_user(object=True, obdata=True)
    assert bpy.ops.object.transform_apply() == {"FINISHED"}


def apply_to_all(scene) -> None:
    select(find_owned_object(scene, "root"), *ours(scene))
    bpy.ops.object.make_single_user(object=True, obdata=True)
    assert bpy.ops.object.transform_apply() == {"FINISHED"}


def clear_parents(scene) -> None:
    select(*ours(scene))
    bpy.ops.object.parent_clear(type="CLEAR_KEEP_TRANSFORM")


def parent_again(scene) -> None:
    clear_parents(scene)
    root = find_owned_object(scene, "root")
    root.select_set(True)
    bpy.context.view_layer.objects.active = root
    bpy.ops.object.parent_set(type="OBJECT")


def apply_parent_inverse(scene) -> None:
    apply_to_root(scene)
    root = find_owned_object(scene, "root")
    root.location.x = 2.0
    select(*ours(scene))
    bpy.ops.object.parent_inverse_apply()


def turn_and_apply_twice(scene) -> None:
    root = find_owned_object(scene, "root")
    for angle in (0.4, -1.1):
        root.matrix_basis = Matrix.Rotation(angle, 4, "X") @ Matrix.Scale(3.0, 4) @ root.matrix_basis
        apply_to_root(scene)


NO_CHANGES = {
    "apply all to the root": apply_to_root,
    "apply the scale of the root": lambda scene: apply_to_root(scene, location=False, rotation=False),
    "apply the rotation of the root": lambda scene: apply_to_root(scene, location=False, scale=False),
    "move the root's transform to deltas": lambda scene: (
        select(find_owned_object(scene, "root")),
        bpy.ops.object.transforms_to_deltas(mode="ALL"),
    ),
    "apply to one fruit": lambda scene: apply_to_fruit(scene, 2),
    "apply to every fruit": lambda scene: apply_to_fruit(scene, 1, 2, 3),
    "apply to everything": apply_to_all,
    "clear all parents": clear_parents,
    "clear all parents and parent again": parent_again,
    "apply the parents' inverse": apply_parent_inverse,
    "turn and scale the root, and apply": turn_and_apply_twice,
    "mirror the root": lambda scene: setattr(find_owned_object(scene, "root"), "scale", (-0.25, 0.25, 0.25)),
    "stretch the root": lambda scene: setattr(find_owned_object(scene, "root"), "scale", (0.25, 0.25, 0.75)),
    "scale the root a hundredfold": lambda scene: setattr(
        find_owned_object(scene, "root"), "scale", (25.0, 25.0, 25.0)
    ),
}


@pytest.fixture(params=NO_CHANGES)
def disturbed(request, shown):
    """The same scene after one of `NO_CHANGES`."""
    bpy.context.view_layer.update()
    NO_CHANGES[request.param](shown)
    bpy.context.view_layer.update()
    return shown


def measures(scene) -> np.ndarray:
    """(F, 17) diameter, volume, position and squared axes of every fruit."""
    fruits = read_fruits(scene).fruits
    assert [each.id for each in fruits] == [1, 2, 3]
    assert not np.isnan([each.diameter_sd for each in fruits]).any()
    return np.array([[each.diameter, each.volume, *each.center, *(each.axes.T @ each.axes).ravel()] for each in fruits])


def expected(counted_with) -> np.ndarray:
    return np.array(
        [
            [each.diameter, np.pi / 6 * each.diameter**3, *each.center, *(each.axes.T @ each.axes).ravel()]
            for each in counted_with().fruit_count.fruits
        ]
    )


def test_what_changes_no_fruit_changes_no_number(disturbed, counted_with):
    np.testing.assert_allclose(measures(disturbed), expected(counted_with), rtol=1e-5, atol=2e-6)


def test_what_changes_no_fruit_is_no_decision(disturbed):
    assert keep_corrections(disturbed) == []
    assert read_log(disturbed) == []
    assert [fruit(number)["diameter"] for number in (1, 2, 3)] == pytest.approx([0.025, 0.05, 0.075])


def test_cameras_stay_where_they_are_in_the_scene(disturbed, counted_with):
    for found, camera in zip(read_cameras(disturbed), counted_with().scene.cameras, strict=True):
        np.testing.assert_allclose(found.world_to_camera, camera.world_to_camera, atol=1e-4)


def test_the_table_is_the_same(shown, tmp_path):
    tables = []
    for disturb in (lambda scene: None, apply_to_root, lambda scene: apply_to_fruit(scene, 1, 2)):
        disturb(shown)
        bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
        rows = [line.split(",") for line in (tmp_path / "a.csv").read_text().splitlines()]
        tables.append(
            [[f"{float(cell):.4g}" if cell.replace(".", "").isdigit() else cell for cell in row] for row in rows]
        )
    assert tables[0] == tables[1] == tables[2]


@pytest.mark.parametrize("disturbed", [each for each in NO_CHANGES if "everything" not in each], indirect=True)
def test_parts_and_added_fruit_lie_where_they_did_before_the_root_was_applied(disturbed, counted_with):
    select(fruit(3))
    assert bpy.ops.fruitlangs.split_fruit(parts=3) == {"FINISHED"}
    assert bpy.ops.fruitlangs.add_fruit(center=(1.0, 2.5, 3.0)) == {"FINISHED"}
    found = {each.id: each for each in read_fruits(disturbed).fruits}
    whole = counted_with().fruit_count.fruits[2]
    assert sum(found[number].volume for number in (4, 5, 6)) == pytest.approx(np.pi / 6 * whole.diameter**3, rel=1e-4)
    middle = np.mean([found[number].center for number in (4, 5, 6)], axis=0)
    np.testing.assert_allclose(middle, whole.center, atol=1e-4)
    np.testing.assert_allclose(found[7].center, (1.0, 2.5, 3.0), atol=1e-5)
    assert fruit(7)["diameter"] == pytest.approx(found[7].diameter * 0.25, rel=1e-4)


def test_a_part_stands_where_its_fruit_did_in_the_world(shown):
    apply_to_root(shown)
    bpy.context.view_layer.update()
    before = fruit(3).matrix_world.translation.copy()
    select(fruit(3))
    bpy.ops.fruitlangs.split_fruit(parts=3)
    bpy.context.view_layer.update()
    parts = [fruit(number).matrix_world.translation for number in (4, 5, 6)]
    np.testing.assert_allclose(sum(parts, Vector()) / 3, before, atol=1e-4)


@pytest.mark.parametrize("disturb", [apply_to_root, lambda scene: apply_to_fruit(scene, 2), apply_to_all])
def test_edits_by_the_user_count_after_apply_too(shown, disturb):
    disturb(shown)
    root = find_owned_object(shown, "root")
    item = fruit(2)
    bpy.context.view_layer.update()
    world = item.matrix_world.copy()
    step = root.matrix_world.to_3x3() @ scene_frame(shown).in_root.to_3x3() @ Vector((0.0, 0.1, 0.0))
    middle = world @ (sum((vertex.co for vertex in item.data.vertices), Vector()) / len(item.data.vertices))
    item.matrix_world = Matrix.Translation(middle + step) @ Matrix.Scale(1.5, 4) @ Matrix.Translation(-middle) @ world
    found = read_fruits(shown).fruits[1]
    assert found.diameter == pytest.approx(0.3, rel=1e-4)
    np.testing.assert_allclose(found.center, (1.3, 2.1, 3.0), atol=1e-4)
    assert np.isnan(found.diameter_sd)
    keep_corrections(shown)
    assert item["diameter"] == pytest.approx(0.075, rel=1e-4)


def test_one_camera_and_the_gaussians_may_be_moved(shown, counted_with):
    find_owned_object(shown, "gaussians").location.x = 5.0
    find_owned_objects(shown, "camera")[0].location.x += 1.0
    np.testing.assert_allclose(measures(shown), expected(counted_with), rtol=1e-5, atol=1e-6)


def test_a_relabelled_fruit_keeps_a_size_that_lies_in_its_mesh(shown):
    apply_to_fruit(shown, 2)
    select(fruit(2))
    bpy.ops.fruitlangs.relabel_fruit(label="ripe apple")
    select(fruit(1))
    bpy.ops.fruitlangs.relabel_fruit(label="ripe apple")
    bpy.ops.fruitlangs.add_fruit(center=(1.0, 2.5, 3.0), diameter=0.2)
    sizes = [each.diameter for each in read_fruits(shown).fruits]
    assert sizes == pytest.approx([0.1, 0.2, 0.3, 0.2], rel=1e-4)


def test_up_length_and_ground_hold_after_the_root_was_applied(shown, counted_with):
    up = read_up(shown)
    apply_to_root(shown)
    np.testing.assert_allclose(read_up(shown), up, atol=1e-5)
    bpy.ops.fruitlangs.set_length(points=(0, 0, 0, 0, 0, 1), length=0.5)
    assert scene_frame(shown).to_world.to_scale()[0] == pytest.approx(0.5, rel=1e-4)
    ground = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0.6, 0.8]])
    bpy.ops.fruitlangs.set_ground(points=ground.ravel().tolist())
    to_world = scene_frame(shown).to_world
    np.testing.assert_allclose([(to_world @ Vector(point)).z for point in ground], 0.0, atol=1e-5)
    assert read_fruits(shown).fruits[1].diameter == pytest.approx(0.2, rel=1e-5)


def test_an_import_after_apply_puts_everything_below_the_root_again(shown, counted_with, result_of, tmp_path):
    bpy.ops.fruitlangs.add_region()
    box = scene_frame(shown).of(find_owned_object(shown, "region"))
    apply_to_root(shown)
    show_result(bpy.context, shown, result_of(counted_with(metres_per_unit=0.25), tmp_path))
    np.testing.assert_allclose(measures(shown), expected(counted_with), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(scene_frame(shown).of(find_owned_object(shown, "region")), box, atol=1e-4)
    assert scene_frame(shown).in_root == Matrix()


def test_fruit_that_stay_when_the_cameras_are_read_again_stay_in_place(shown, counted_with):
    from fruitlangs.operators.steps.show_result import show_scene

    apply_to_root(shown)
    show_scene(bpy.context, shown, counted_with(metres_per_unit=0.25).scene)
    np.testing.assert_allclose(measures(shown), expected(counted_with), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(fruit(2).location, counted_with().fruit_count.fruits[1].center, atol=1e-5)


def test_a_root_scaled_to_zero_and_applied_is_refused(shown):
    find_owned_object(shown, "root").scale = (0.0, 0.0, 0.0)
    apply_to_root(shown)
    with pytest.raises(SceneError, match=REMEDY):
        read_fruits(shown)


def test_up_of_a_root_scaled_to_zero_is_that_of_the_scene(shown, counted_with):
    find_owned_object(shown, "root").scale = (0.0, 0.0, 0.0)
    np.testing.assert_allclose(read_up(shown), counted_with().scene.up, atol=1e-6)


def test_fruit_moved_together_away_from_the_cameras_are_refused(shown):
    for number in (1, 2):
        fruit(number).location.x += 5.0
    with pytest.raises(SceneError, match=f"2 of 3 fruit are not where they were counted.*{REMEDY}"):
        read_fruits(shown)


def test_fruit_taken_out_of_the_root_that_then_moves_are_refused(shown):
    select(*find_owned_objects(shown, "fruit"))
    bpy.ops.object.parent_clear(type="CLEAR_KEEP_TRANSFORM")
    find_owned_object(shown, "root").scale *= 4.0
    with pytest.raises(RuntimeError, match=REMEDY):
        bpy.ops.fruitlangs.export_csv(filepath="/nowhere/a.csv")


def test_cameras_that_were_all_moved_apart_are_refused(shown):
    for step, camera in enumerate(find_owned_objects(shown, "camera")):
        camera.location.x += 1.0 + step
    find_owned_object(shown, "gaussians").location.x = 3.0
    with pytest.raises(SceneError, match="do not fit together"):
        scene_frame(shown)


def test_an_import_is_the_remedy_and_says_what_is_not_kept(shown, counted_with, result_of, tmp_path):
    for number in (1, 2):
        fruit(number).location.x += 5.0
    show_result(bpy.context, shown, result_of(counted_with(metres_per_unit=0.25), tmp_path))
    assert "changes by hand are not kept" in shown.fruitlangs.result.notices
    np.testing.assert_allclose(measures(shown), expected(counted_with), rtol=1e-5, atol=1e-6)


def test_a_count_says_how_many_fruit_lose_what_the_user_moved_or_scaled(shown, counted_with, result_of, tmp_path):
    result = result_of(counted_with(metres_per_unit=0.25), tmp_path)
    show_result(bpy.context, shown, result)
    assert "as counted again" not in shown.fruitlangs.result.notices
    fruit(1).scale *= 1.1
    show_result(bpy.context, shown, result)
    assert "1 fruit that you moved or scaled are as counted again" in shown.fruitlangs.result.notices
    fruit(2).location.x += 0.02 * fruit(2).scale.x
    show_result(bpy.context, shown, result)
    assert "1 fruit that you moved or scaled are as counted again" in shown.fruitlangs.result.notices


def test_a_mesh_that_is_no_ellipsoid_is_refused_by_its_name(shown):
    select(fruit(1))
    bpy.ops.object.make_single_user(object=True, obdata=True)
    for vertex in fruit(1).data.vertices:
        vertex.co.x = max(vertex.co.x, 0.0)
    with pytest.raises(CountingError, match=r"mesh of apple\.001 was edited"):
        read_fruits(shown)
    bpy.ops.object.delete()
    assert [each.id for each in read_fruits(shown).fruits] == [2, 3]


def test_without_cameras_and_gaussians_the_fruit_say_where_the_scene_is(shown, counted_with):
    bpy.data.batch_remove([find_owned_object(shown, "gaussians"), *find_owned_objects(shown, "camera")])
    apply_to_root(shown)
    np.testing.assert_allclose(measures(shown), expected(counted_with), rtol=1e-5, atol=1e-6)


def test_a_file_without_stored_poses_is_read_by_its_gaussians(shown, counted_with):
    for item in ours(shown):
        item.pop("scene_pose", None)
    apply_to_root(shown)
    np.testing.assert_allclose(measures(shown), expected(counted_with), rtol=1e-5, atol=1e-6)


def test_the_ordinary_scene_is_read_bit_for_bit(shown):
    item = fruit(2)
    placed = np.array(item.matrix_basis)
    found = read_fruits(shown).fruits[1]
    assert found.center.tolist() == placed[:3, 3].tolist()
    assert sorted(np.linalg.norm(found.axes, axis=1)) == sorted(np.linalg.norm(0.5 * placed[:3, :3], axis=0))


def test_gaussians_that_were_applied_are_refused_where_their_places_count(shown, tmp_path):
    apply_to_all(shown)
    select(fruit(3))
    for act, given in (("export_still", {"filepath": str(tmp_path / "a.jpg")}), ("split_fruit", {"parts": 2})):
        with pytest.raises(RuntimeError, match=rf"points of Gaussians were moved within its mesh.*{REMEDY}"):
            getattr(bpy.ops.fruitlangs, act)(**given)
    assert len(read_log(shown)) == 0


def test_gaussians_of_which_some_were_deleted_keep_their_places(shown):
    item = find_owned_object(shown, "gaussians")
    places = point_positions(item)
    select(item)
    item.data.vertices.foreach_set("select", np.arange(20) < 7)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.object.mode_set(mode="OBJECT")
    np.testing.assert_array_equal(point_positions(item), places[7:])
    item.data.transform(Matrix.Scale(4.0, 4))
    with pytest.raises(SceneError, match=REMEDY):
        point_positions(item)


def test_gaussians_that_were_shrunk_within_their_mesh_are_refused(shown):
    item = find_owned_object(shown, "gaussians")
    middle = Vector(point_positions(item).mean(axis=0).tolist())
    item.data.transform(Matrix.Translation(middle) @ Matrix.Scale(0.5, 4) @ Matrix.Translation(-middle))
    with pytest.raises(SceneError, match=REMEDY):
        point_positions(item)
