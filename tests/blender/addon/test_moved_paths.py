"""Paths in the panel stay true wherever the .blend is saved."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import bpy
import pytest

from fruitlangs.operators.settings import moved_paths
from fruitlangs.operators.settings.settings import read_config, source_folder, stored_file


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
        assert stored_file(settings.result.folder) == tmp_path / "here" / "tree_fruit"
        assert stored_file(settings.result.features).parent == tmp_path / "here" / "tree_fruit"
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
