"""Check Photos in step 1: the findings in the panel, and the contact sheet as an image."""

from __future__ import annotations

import bpy
import pytest
from blender_examples import drawn
from PIL import Image

from fruitlangs.engine.photo_check.finding import CheckedPhoto, Finding, PhotoCheck
from fruitlangs.fruitlangs_addon.panels.step_scene import FRUITLANGS_PT_scene
from fruitlangs.operators.steps import check_photos

BLUR = Finding(kind="blur", severity="warning", sentence="1 photo is blurred: a.jpg", advice="Take it again")
FEW = Finding(kind="few photos", severity="problem", sentence="There are only 2 photos", advice="Take 40")


@pytest.fixture
def photos(extension, tmp_path):
    """Two photos, chosen as the scene."""
    folder = tmp_path / "tree"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg"):
        Image.effect_noise((64, 48), 60).convert("RGB").save(folder / name)
    bpy.context.scene.fruitlangs.source = str(folder)
    return folder


@pytest.fixture
def checked(photos, monkeypatch):
    """In place of the engine's check: these findings at once."""

    def set_findings(*findings):
        two = [CheckedPhoto(name=name, thumbnail=Image.new("RGB", (32, 24))) for name in ("a.jpg", "b.jpg")]
        result = PhotoCheck(folder=photos, photos=two, findings=findings, costs=[])
        monkeypatch.setattr("fruitlangs.engine.photo_check.check.check_photos", lambda *_, **__: result)

    return set_findings


def test_the_photos_of_the_chosen_folder_are_checked_by_the_engine(photos):
    assert bpy.ops.fruitlangs.check_photos() == {"FINISHED"}
    check = bpy.context.scene.fruitlangs.check
    assert check.summary.startswith("2 photos: ")
    assert any("There are only 2 photos" in item.text and item.problem for item in check.findings)


def test_the_panel_shows_each_finding_with_what_to_do(checked):
    checked(FEW, BLUR)
    bpy.ops.fruitlangs.check_photos()
    texts = drawn(FRUITLANGS_PT_scene).text
    assert "1 problem, 1 warning" in texts
    assert "There are only 2 photos. Take 40" in texts
    assert "Take it again" in texts


def test_a_second_check_replaces_the_findings_and_the_sheet(checked):
    checked(FEW, BLUR)
    bpy.ops.fruitlangs.check_photos()
    checked(BLUR)
    bpy.ops.fruitlangs.check_photos()
    assert [item.text for item in bpy.context.scene.fruitlangs.check.findings] == [BLUR.text]
    assert [image.name for image in bpy.data.images] == [check_photos.SHEET]


def test_the_sheet_is_stored_in_the_blend(checked):
    checked(BLUR)
    bpy.ops.fruitlangs.check_photos()
    image = bpy.data.images[check_photos.SHEET]
    assert image.packed_file is not None
    assert min(image.size) > 24
    assert image.filepath == image.packed_files[0].filepath == "//fruitlangs_contact_sheet.jpg"  # no temporary folder


def test_findings_of_another_scene_are_not_shown(checked, tmp_path):
    checked(FEW)
    bpy.ops.fruitlangs.check_photos()
    bpy.context.scene.fruitlangs.source = str(tmp_path / "other")
    assert "There are only 2 photos" not in drawn(FRUITLANGS_PT_scene).text


def test_without_a_scene_the_button_is_off(extension):
    assert not bpy.ops.fruitlangs.check_photos.poll()


def test_a_folder_without_photos_is_an_error_in_the_panel(photos):
    for file in photos.iterdir():
        file.unlink()
    with pytest.raises(RuntimeError, match="has no photos"):
        bpy.ops.fruitlangs.check_photos()
    assert bpy.context.scene.fruitlangs.failed == "Photo Check"
