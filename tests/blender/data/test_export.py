"""What is exported is what stands after the review, in every format, whole or not at all."""

from __future__ import annotations

import csv
import json
import re

import bpy
import numpy as np
import pytest
import trimesh
from mathutils import Matrix
from PIL import Image
from plyfile import PlyData

from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects
from fruitlangs.operators.export.export import NAMES
from fruitlangs.operators.export.export_file import choose_default_path
from fruitlangs.operators.export.export_usd import has_usd
from fruitlangs.operators.steps.show_result import show_result

needs_usd = pytest.mark.skipif(not has_usd(), reason="this Blender was built without USD")
ALL = [
    pytest.param(item.bl_idname.partition(".")[2], item.suffixes[0], id=item.__name__, marks=needs_usd)
    if "usd" in item.bl_idname
    else pytest.param(item.bl_idname.partition(".")[2], item.suffixes[0], id=item.__name__)
    for item in NAMES
]


@pytest.fixture
def shown(extension, counted_with, result_of, tmp_path):
    """Three apples of diameters .2, .4 and .6 m in a scene of which a unit is 2 m."""
    show_result(bpy.context, bpy.context.scene, result_of(counted_with(metres_per_unit=2.0), tmp_path / "out"))
    return bpy.context.scene


@pytest.fixture
def reviewed(shown):
    """Apple 1 moved, 2 rejected, 3 called a pear: apple 1 and pear 3 are left."""
    fruit(2).select_set(True)
    bpy.ops.fruitlangs.reject_fruit(reason="a leaf")
    fruit(2).select_set(False)
    fruit(3).select_set(True)
    bpy.ops.fruitlangs.relabel_fruit(label="pear")
    fruit(1).location.x = 4.0
    return shown


def fruit(number):
    return next(item for item in find_owned_objects(bpy.context.scene, "fruit") if item["id"] == number)


def export(name, path, **options):
    return getattr(bpy.ops.fruitlangs, name)(filepath=str(path), **options)


def world(item):
    return np.array(find_owned_object(bpy.context.scene, "root").matrix_basis @ item.matrix_basis.translation)


def test_the_table_has_the_corrected_fruit(reviewed, tmp_path):
    assert export("export_csv", tmp_path / "a.csv") == {"FINISHED"}
    rows = list(csv.DictReader((tmp_path / "a.csv").open(encoding="utf-8")))
    assert [(row["id"], row["label"]) for row in rows] == [("1", "apple"), ("3", "pear")]
    assert [float(row["diameter_mm"]) for row in rows] == pytest.approx([200.0, 600.0], rel=1e-4)
    assert [float(row["x_units"]) for row in rows] == pytest.approx([4.0, 1.6], rel=1e-5)


def test_a_size_that_the_user_gave_has_no_deviation_in_the_table(reviewed, tmp_path):
    fruit(1).scale *= 2.0
    export("export_csv", tmp_path / "a.csv")
    rows = list(csv.DictReader((tmp_path / "a.csv").open(encoding="utf-8")))
    assert float(rows[0]["diameter_mm"]) == pytest.approx(400.0, rel=1e-4)
    assert (rows[0]["diameter_sd_mm"], rows[1]["diameter_sd_mm"]) == ("", "20.00")


def test_gltf_has_a_named_upright_mesh_for_each_corrected_fruit(reviewed, tmp_path):
    export("export_glb", tmp_path / "a.glb")
    scene = trimesh.load(tmp_path / "a.glb")
    assert sorted(scene.geometry) == ["apple.001", "pear.003"]
    assert scene.geometry["pear.003"].volume == pytest.approx(np.pi / 6 * 0.6**3, rel=0.1)
    assert scene.geometry["pear.003"].metadata["diameter"] == pytest.approx(0.6, rel=1e-5)
    centers = [scene.graph.get(name)[0][:3, 3] for name in ("apple.001", "pear.003")]
    lift = world(fruit(3))[2] - world(fruit(1))[2]
    assert centers[1][1] - centers[0][1] == pytest.approx(lift, abs=1e-5)


def test_obj_has_an_object_for_each_corrected_fruit(reviewed, tmp_path):
    export("export_obj", tmp_path / "a.obj")
    text = (tmp_path / "a.obj").read_text(encoding="utf-8")
    names = [line for line in text.splitlines() if line.startswith("o ")]
    assert len(names) == 2
    assert "pear" in names[1]
    assert "mtllib a.mtl" in text
    assert (tmp_path / "a.mtl").is_file()
    bodies = trimesh.load(tmp_path / "a.obj", force="mesh").split()
    assert sorted(body.volume for body in bodies)[1] == pytest.approx(np.pi / 6 * 0.6**3, rel=0.1)


def test_ply_gives_every_vertex_its_fruit(reviewed, tmp_path):
    export("export_ply", tmp_path / "a.ply")
    vertices = PlyData.read(str(tmp_path / "a.ply"))["vertex"]
    assert set(vertices["fruit_id"].tolist()) == {1, 3}


@needs_usd
def test_usd_has_the_corrected_objects_where_blender_shows_them(reviewed, tmp_path):
    fruit(1).hide_viewport = True  # out of the way, yet counted
    fruit(3).hide_set(True)
    places = {name: world(fruit(number)) for name, number in (("apple_001", 1), ("pear_003", 3))}
    before = {item.name: [each.name for each in item.data.materials] for item in find_owned_objects(reviewed, "fruit")}
    assert export("export_usd", tmp_path / "a.usdc") == {"FINISHED"}
    assert fruit(1).hide_viewport
    assert fruit(3).hide_get()
    assert {
        item.name: [each.name for each in item.data.materials] for item in find_owned_objects(reviewed, "fruit")
    } == (before)
    assert not [item for item in bpy.data.collections if "USD" in item.name]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=str(tmp_path / "a.usdc"))
    meshes = {item.name: item for item in bpy.data.objects if item.type == "MESH"}
    found = {item.parent.name if item.parent else item.name: item for item in meshes.values()}
    told = {}
    for item in meshes.values():
        for each in (item, item.parent):
            if each is not None and "id" in each:
                told[int(each["id"])] = item
    assert sorted(told) == [1, 3], (list(meshes), list(found))
    bpy.context.view_layer.update()
    for number, place in ((1, places["apple_001"]), (3, places["pear_003"])):
        np.testing.assert_allclose(np.array(told[number].matrix_world.translation), place, atol=1e-4)
    size = np.array(told[3].dimensions)
    assert np.prod(size) == pytest.approx(0.6**3, rel=0.05)


def test_the_report_gives_the_corrected_count_and_every_decision(reviewed, tmp_path):
    assert export("export_report", tmp_path / "a.html") == {"FINISHED"}
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "counted 3, after review 2" in text
    assert "a leaf" in text
    assert "pear" in text
    assert "data:image/jpeg;base64" in text


def test_a_report_gives_no_folders_and_no_deviation_of_a_size_that_the_user_gave(reviewed, tmp_path):
    fruit(1).scale *= 2.0
    export("export_report", tmp_path / "a.html")
    text = re.sub(r"base64,[A-Za-z0-9+/=]+", "", (tmp_path / "a.html").read_text(encoding="utf-8"))
    assert str(tmp_path) not in text
    assert "± nan" not in text
    assert "<td>400</td>" in text.replace(' class="number"', "")


def test_the_report_of_a_count_without_review_does_not_mention_one(shown, tmp_path):
    export("export_report", tmp_path / "a.html")
    assert "after review" not in (tmp_path / "a.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(("suffix", "kind"), [(".jpg", "JPEG"), (".png", "PNG")])
def test_a_still_is_framed_by_itself_as_wide_as_asked(reviewed, tmp_path, suffix, kind):
    export("export_still", tmp_path / f"a{suffix}", width=320)
    with Image.open(tmp_path / f"a{suffix}") as picture:
        assert picture.format == kind
        assert picture.width == 320


def test_a_still_from_the_active_camera_has_the_renders_size(shown, tmp_path):
    shown.render.resolution_x, shown.render.resolution_y = 200, 100
    export("export_still", tmp_path / "a.png", view="CAMERA")
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width == 200


def test_a_still_from_a_camera_that_is_not_there_says_so(shown, tmp_path):
    shown.camera = None
    with pytest.raises(RuntimeError, match="no active camera"):
        export("export_still", tmp_path / "a.png", view="CAMERA")
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize(("name", "suffix"), ALL)
def test_what_cannot_be_written_is_reported_plainly(shown, tmp_path, name, suffix):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(RuntimeError, match="cannot be written"):
        export(name, tmp_path / "file" / f"a{suffix}")
    assert (tmp_path / "file").read_text() == "mine"
    assert bpy.context.scene.fruitlangs.failed == "Export"


@pytest.mark.parametrize(("name", "suffix"), ALL)
def test_what_fails_midway_leaves_the_old_file(shown, tmp_path, name, suffix, monkeypatch):
    import os

    old = tmp_path / f"a{suffix}"
    old.write_text("old")

    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(RuntimeError, match="No space left"):
        export(name, old)
    assert old.read_text() == "old"
    assert [path.name for path in tmp_path.glob("*.part*")] == []


@pytest.mark.parametrize(("name", "suffix"), ALL)
def test_a_count_of_nothing_is_exported_too(extension, counted_with, result_of, tmp_path, name, suffix):
    show_result(bpy.context, bpy.context.scene, result_of(counted_with(fruits=0), tmp_path / "out"))
    assert export(name, tmp_path / f"a{suffix}") == {"FINISHED"}
    assert (tmp_path / f"a{suffix}").stat().st_size > 0


@pytest.mark.parametrize(("name", "suffix"), ALL)
def test_before_a_count_a_button_says_why_it_cannot(extension, tmp_path, name, suffix):
    with pytest.raises(RuntimeError, match="Count first"):
        export(name, tmp_path / f"a{suffix}")


@pytest.mark.parametrize(("name", "suffix"), ALL)
def test_background_mode_writes_without_a_dialog(shown, tmp_path, name, suffix):
    # A name without a suffix gets the format's own.
    assert getattr(bpy.ops.fruitlangs, name)("INVOKE_DEFAULT", filepath=str(tmp_path / "b")) == {"FINISHED"}
    assert (tmp_path / f"b{suffix}").is_file()


def test_an_export_without_a_file_name_or_into_a_folder_says_what_to_do(shown, tmp_path):
    with pytest.raises(RuntimeError, match="Choose a file"):
        export("export_csv", "")
    with pytest.raises(RuntimeError, match="Add a file name"):
        export("export_csv", tmp_path)
    with pytest.raises(RuntimeError, match="never saved"):
        export("export_csv", "//a.csv")


def test_files_are_proposed_next_to_the_blend_and_before_that_next_to_the_results(shown, tmp_path):
    shown.fruitlangs.source = str(tmp_path / "row 7")
    assert choose_default_path(shown, ".csv") == tmp_path / "row 7_fruit.csv"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "tree.blend"))
    assert choose_default_path(bpy.context.scene, ".csv") == tmp_path / "tree_fruit.csv"


def test_an_export_changes_nothing_in_the_file(reviewed, tmp_path):
    def told():
        kinds = ("objects", "meshes", "materials", "collections", "cameras", "images")
        return {kind: sorted(item.name for item in getattr(bpy.data, kind)) for kind in kinds}

    before, chosen = told(), list(bpy.context.selected_objects)
    for item in NAMES:
        if has_usd() or "usd" not in item.bl_idname:
            export(item.bl_idname.partition(".")[2], tmp_path / f"c{item.suffixes[0]}")
    assert told() == before
    assert list(bpy.context.selected_objects) == chosen


def test_fruit_of_another_scene_in_the_file_are_not_exported(shown, counted_with, result_of, tmp_path):
    other = bpy.data.scenes.new("Row 2")
    show_result(bpy.context, other, result_of(counted_with(fruits=1), tmp_path / "other"))
    export("export_glb", tmp_path / "a.glb")
    assert len(trimesh.load(tmp_path / "a.glb").geometry) == 3


def test_a_turned_root_changes_neither_table_nor_meshes(shown, tmp_path):
    export("export_csv", tmp_path / "a.csv")
    find_owned_object(shown, "root").matrix_basis = (
        Matrix.Translation((5, 0, 0)) @ find_owned_object(shown, "root").matrix_basis
    )
    export("export_csv", tmp_path / "b.csv")
    assert (tmp_path / "a.csv").read_text() == (tmp_path / "b.csv").read_text()


def test_the_tables_number_of_fruit_is_that_of_the_gltf(reviewed, tmp_path):
    export("export_glb", tmp_path / "a.glb")
    content = (tmp_path / "a.glb").read_bytes()
    document = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    assert len(document["meshes"]) == 2
