"""Paths in the panel stay true wherever the .blend is saved."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bpy
import pytest
from blender_examples import drawn

from fruitlangs.fruitlangs_addon.panels.step_scene import ANOTHER_DRIVE, FRUITLANGS_PT_scene
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects
from fruitlangs.operators.data.photo_files import photo_path
from fruitlangs.operators.settings import moved_paths
from fruitlangs.operators.settings.settings import (
    PHOTO_FILE,
    PHOTO_PROBLEM,
    is_of_another,
    make_relative_path,
    read_config,
    resolve_stored_file,
    source_folder,
)
from fruitlangs.operators.steps.show_result import show_result
from fruitlangs.operators.steps.shown_source import enter_source


@pytest.fixture
def saved(extension, tmp_path):
    """A .blend in `here` that shows a scene and results next to it."""
    for name in ("here/tree", "here/tree_fruit", "there/deep"):
        (tmp_path / name).mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "here" / "a.blend"))
    settings = bpy.context.scene.fruitlangs
    settings.source, settings.out, settings.prompt = "//tree/", "//tree_fruit", "pear"
    settings.result.folder, settings.result.features = "//tree_fruit", "//tree_fruit/features.safetensors"
    return settings


def test_a_file_saved_into_another_folder_still_finds_its_scene_and_results(saved, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "there" / "deep" / "b.blend"))
    for _ in range(2):
        settings = bpy.context.scene.fruitlangs
        assert settings.out == "//../../here/tree_fruit"
        assert source_folder(settings) == tmp_path / "here" / "tree"
        assert resolve_stored_file(settings.result.folder) == tmp_path / "here" / "tree_fruit"
        assert resolve_stored_file(settings.result.features).parent == tmp_path / "here" / "tree_fruit"
        bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "there" / "deep" / "b.blend"))


def path_properties(group: Any) -> Iterator[tuple[Any, str]]:
    """Every property of a group and of the groups in it that is a path."""
    for each in group.bl_rna.properties:
        if each.type == "STRING" and each.subtype in ("FILE_PATH", "DIR_PATH"):
            yield group, each.identifier
        if each.type == "POINTER" and isinstance(getattr(group, each.identifier, None), bpy.types.PropertyGroup):
            yield from path_properties(getattr(group, each.identifier))


def test_every_path_of_the_panel_is_kept_true(saved, tmp_path):
    paths = list(path_properties(saved))
    for group, name in paths:
        setattr(group, name, "//tree")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "there" / "b.blend"))
    assert {f"{type(group).__name__}.{name}": getattr(group, name) for group, name in paths} == {
        f"{type(group).__name__}.{name}": "//../here/tree" for group, name in paths
    }
    assert {"source", "out", "folder"} <= {name for _, name in paths}


def test_a_saved_copy_finds_them_and_the_open_file_still_does(saved, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "there" / "b.blend"), copy=True)
    assert saved.out == "//tree_fruit"
    assert source_folder(saved) == tmp_path / "here" / "tree"
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "there" / "b.blend"))
    assert source_folder(bpy.context.scene.fruitlangs) == tmp_path / "here" / "tree"


def test_paths_among_the_stages_settings_are_kept_true_too_and_names_of_the_hub_as_they_are(saved, tmp_path):
    saved.config.count.method, saved.config.count.template = "template", "//apple.ply"
    saved.config.embed.sam = "//sam"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "there" / "b.blend"))
    config = read_config(bpy.context.scene.fruitlangs)
    assert config.count.template == str(tmp_path / "here" / "apple.ply")
    assert config.embed.sam == str(tmp_path / "here" / "sam")
    assert config.embed.clip == "openai/clip-vit-base-patch16"


def test_a_file_that_could_not_be_saved_elsewhere_still_finds_them(saved, tmp_path):
    with pytest.raises(RuntimeError, match="Cannot open file"):
        bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "gone" / "b.blend"))
    assert saved.out == "//tree_fruit"


def test_saving_in_place_changes_no_path(saved):
    bpy.ops.wm.save_mainfile()
    assert (saved.source, saved.out) == ("//tree/", "//tree_fruit")


def test_enabling_twice_leaves_one_handler_and_disabling_none(extension):
    def registered():
        return [list(getattr(bpy.app.handlers, name)).count(each) for name, each in moved_paths.HANDLERS.items()]

    extension.register()
    assert registered() == [1, 1, 1]
    extension.unregister()
    assert registered() == [0, 0, 0]


@pytest.fixture
def unsaved(extension, counted_balls, balls, tmp_path, monkeypatch):
    """The balls' count shown in a file that was never saved; its photos are in a folder of the user's home."""
    home = tmp_path / "home" / "ana"
    monkeypatch.setenv("HOME", str(home))
    photos = Path(shutil.copytree(balls, home / "row" / "tree"))
    settings = bpy.context.scene.fruitlangs
    settings.source, settings.out = f"{photos}/", str(home / "row" / "tree_fruit")
    origin = {**counted_balls.origin, "source": str(photos)}
    show_result(bpy.context, bpy.context.scene, dataclasses.replace(counted_balls, origin=origin))
    for item in find_owned_objects(bpy.context.scene, "camera"):
        item[PHOTO_FILE] = str(photos / Path(item[PHOTO_FILE]).relative_to(balls))
    return photos


def shown_paths() -> list[str]:
    """What the open file has of a path that leaves the folder of the .blend or is absolute."""
    return [stored.text for stored in moved_paths.iterate_stored_paths() if stored.text.startswith(("/", "//.."))]


def test_the_first_save_makes_every_path_relative(unsaved):
    settings = bpy.context.scene.fruitlangs
    aside = settings.review.aside.add()
    aside.source = str(unsaved.parent / "other")
    bpy.context.view_layer.objects.active = find_owned_object(bpy.context.scene, "fruit")
    bpy.ops.fruitlangs.best_photo()
    settings.result.folder = settings.result.features = ""  # of another folder here
    assert len(shown_paths()) > 10
    bpy.ops.wm.save_as_mainfile(filepath=str(unsaved.parent / "a.blend"))
    assert (settings.source, settings.out, settings.result.source) == ("//tree", "//tree_fruit", "//tree")
    assert aside.source == "//other"
    assert bpy.data.images[0].filepath.startswith("//tree/images/")
    assert all(item[PHOTO_FILE].startswith("//tree/") for item in find_owned_objects(bpy.context.scene, "camera"))
    assert [text for text in shown_paths() if not text.startswith("//")] == []


def test_a_folder_that_is_moved_with_its_blend_is_found_with_photos_and_decisions(unsaved, tmp_path):
    settings = bpy.context.scene.fruitlangs
    settings.review.log.add().action = "confirm"
    bpy.ops.wm.save_as_mainfile(filepath=str(unsaved.parent / "a.blend"))
    moved = tmp_path / "elsewhere"
    unsaved.parent.rename(moved)
    bpy.ops.wm.open_mainfile(filepath=str(moved / "a.blend"))
    bpy_scene = bpy.context.scene
    assert source_folder(bpy_scene.fruitlangs) == moved / "tree"
    assert not is_of_another(bpy_scene.fruitlangs, moved / "tree")
    assert {photo_path(item).parent for item in find_owned_objects(bpy_scene, "camera")} == {moved / "tree" / "images"}
    assert enter_source(bpy_scene, moved / "tree") == []
    assert len(bpy_scene.fruitlangs.review.log) == 1


def test_no_home_folder_is_in_a_file_that_is_saved_next_to_its_photos(unsaved, monkeypatch):
    settings = bpy.context.scene.fruitlangs
    settings.error = settings.result.notices = settings.teach.saved = f"{Path.home()}/words cannot be read"
    settings.check.findings.add().text = f"{Path.home()}/row/tree/1.jpg is blurred"
    find_owned_object(bpy.context.scene, "camera")[PHOTO_PROBLEM] = f"{Path.home()}/row/1.jpg is gone"
    settings.result.folder = settings.result.features = ""
    file = unsaved.parent / "a.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file), compress=False)
    content = file.read_bytes().replace(str(file).encode(), b"")  # Blender writes the name of every file into it
    assert b"tree/images" in content
    assert str(Path.home()).encode() not in content
    assert settings.error == "~/words cannot be read"


def test_a_photo_in_blenders_temporary_folder_is_shown_on_and_not_in_the_file(unsaved, monkeypatch, tmp_path):
    temporary = tmp_path / "home" / "ana" / "blender_a1b2"
    temporary.mkdir()
    shutil.copy(next((unsaved / "images").iterdir()), temporary / "undistorted.png")
    image = bpy.data.images.load(str(temporary / "undistorted.png"))
    image["fruitlangs"], image.use_fake_user = "photo", True
    monkeypatch.setattr(moved_paths, "find_temporary_folder", lambda: temporary)
    file = unsaved.parent / "a.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file), compress=False)
    assert image.filepath == str(temporary / "undistorted.png")
    assert b"blender_a1b2" not in file.read_bytes()


def test_a_copy_of_a_file_that_was_never_saved_leaves_its_paths_absolute(unsaved):
    before = [stored.text for stored in moved_paths.iterate_stored_paths()]
    file = unsaved.parent / "copy.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file), copy=True)
    after = [stored.text for stored in moved_paths.iterate_stored_paths()]
    assert [text.rstrip("/") for text in after] == [text.rstrip("/") for text in before]
    bpy.ops.wm.open_mainfile(filepath=str(file))
    assert bpy.context.scene.fruitlangs.source == "//tree"


def test_a_path_that_is_typed_later_is_relative_after_the_next_save(saved, tmp_path):
    saved.out = str(tmp_path / "here" / "tree_fruit")
    saved.config.embed.clip = "openai/clip-vit-base-patch16"
    bpy.ops.wm.save_mainfile()
    assert (saved.out, saved.config.embed.clip) == ("//tree_fruit", "openai/clip-vit-base-patch16")


def test_a_path_on_another_drive_stays_absolute_and_the_panel_says_so(unsaved, monkeypatch):
    def other_drive(*_args: Any, **_kwargs: Any) -> str:
        raise ValueError("path is on mount 'C:', start on mount 'D:'")

    assert ANOTHER_DRIVE not in drawn(FRUITLANGS_PT_scene).texts
    monkeypatch.setattr(bpy.path, "relpath", other_drive)
    bpy.ops.wm.save_as_mainfile(filepath=str(unsaved.parent / "a.blend"))
    assert bpy.context.scene.fruitlangs.source.rstrip("/") == str(unsaved)
    assert ANOTHER_DRIVE in drawn(FRUITLANGS_PT_scene).texts
    monkeypatch.undo()
    assert ANOTHER_DRIVE not in drawn(FRUITLANGS_PT_scene).texts


def test_a_relative_path_is_right_through_symbolic_links(tmp_path):
    (tmp_path / "disk" / "deep" / "tree").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "deep")
    assert make_relative_path(tmp_path / "disk" / "deep" / "tree", tmp_path / "link") == "//tree"
    assert make_relative_path(tmp_path / "link" / "tree", tmp_path / "disk" / "deep") == "//tree"
    (tmp_path / "photos").mkdir()
    # From the link, .. leads to tmp_path for Blender and to the disk for the file system.
    assert make_relative_path(tmp_path / "photos", tmp_path / "link") == str(tmp_path / "photos")
