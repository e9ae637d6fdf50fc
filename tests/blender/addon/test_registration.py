from __future__ import annotations

import bpy

import fruitlangs


def operators() -> list[str]:
    return dir(bpy.ops.fruitlangs)


def test_registering_twice_is_as_registering_once(extension):
    extension.register()
    assert "count" in operators()
    assert bpy.context.scene.fruitlangs.prompt == "apple"


def test_unregistering_leaves_nothing_behind():
    fruitlangs.register()
    draw_functions = len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs)
    fruitlangs.unregister()
    assert operators() == []
    assert not hasattr(bpy.types.Scene, "fruitlangs")
    assert not [name for name in dir(bpy.types) if "FRUITLANGS" in name]
    assert len(bpy.types.TOPBAR_MT_file_import.draw._draw_funcs) == draw_functions - 1
    fruitlangs.unregister()


def test_every_class_of_the_list_is_registered_and_named_by_blenders_rules(extension):
    from fruitlangs.fruitlangs_addon.registration import CLASSES

    assert all(item.is_registered for item in CLASSES)
    assert all(item.__name__.startswith("FRUITLANGS_") for item in CLASSES)
    assert all(item.bl_description for item in CLASSES if issubclass(item, bpy.types.Operator))


def test_settings_survive_saving_and_loading(extension, tmp_path):
    settings = bpy.context.scene.fruitlangs
    settings.prompt, settings.config.train.steps = "pear", 123
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    settings = bpy.context.scene.fruitlangs
    assert (settings.prompt, settings.config.train.steps) == ("pear", 123)
