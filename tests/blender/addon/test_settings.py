from __future__ import annotations

import dataclasses
from pathlib import Path

import bpy
import pytest

from fruitlangs.engine.config import PRESETS, STAGES, Config, UnitsConfig
from fruitlangs.engine.errors import ConfigError, SceneError, VocabularyError
from fruitlangs.engine.setting import field_docs
from fruitlangs.fruitlangs_addon.panels.settings_panels import settings_of
from fruitlangs.operators.settings import settings as conversions


def test_untouched_settings_are_the_configs_defaults(extension):
    assert conversions.read_config(bpy.context.scene.fruitlangs) == Config()


def test_every_setting_of_every_stage_has_a_property_with_its_text(extension):
    for stage, config_class in conversions.stage_classes().items():
        properties = getattr(bpy.context.scene.fruitlangs.config, stage).bl_rna.properties
        for field in dataclasses.fields(config_class):
            text = field_docs(config_class)[field.name]
            assert properties[field.name].description.startswith(text.rstrip("."))


def test_settings_that_are_paths_have_a_button_that_looks_for_them(extension):
    config = bpy.context.scene.fruitlangs.config
    subtypes = {
        f"{stage}.{name}": getattr(config, stage).bl_rna.properties[name].subtype
        for stage, kind in conversions.stage_classes().items()
        for name in conversions.path_names(kind)
    }
    folders = dict.fromkeys(("embed.clip", "embed.sam", "embed.words"), "DIR_PATH")
    assert subtypes == {**folders, "count.template": "FILE_PATH"}


def test_a_path_relative_to_a_blend_never_saved_is_an_error_that_says_so(extension):
    bpy.context.scene.fruitlangs.config.embed.clip = "//clip"
    with pytest.raises(SceneError, match="never saved"):
        conversions.read_config(bpy.context.scene.fruitlangs)


def test_every_setting_is_in_one_panel_and_the_experimental_ones_are_in_panels_of_their_own(extension):
    shown = {
        level: {f"{stage}.{name}" for stage in STAGES for name in settings_of(stage, level)}
        for level in ("common", "advanced", "experimental")
    }
    everything = {f"{stage}.{field.name}" for stage, kind in STAGES.items() for field in dataclasses.fields(kind)}
    assert sum(map(len, shown.values())) == len(everything)
    assert set.union(*shown.values()) == everything
    assert "count.threshold" in shown["common"]
    assert "train.literal_pairs" in shown["experimental"]
    panel = bpy.types.FRUITLANGS_PT_count_experimental
    assert (panel.bl_parent_id, panel.bl_label) == ("FRUITLANGS_PT_count_settings", "Experimental")


def test_changed_settings_arrive_as_typed(extension):
    config = bpy.context.scene.fruitlangs.config
    config.count.threshold, config.count.method, config.train.steps = 0.3, "template", 77
    read = conversions.read_config(bpy.context.scene.fruitlangs)
    assert (read.count.threshold, read.count.method, read.train.steps) == (0.3, "template", 77)


def test_nothing_is_downloaded_where_blender_may_not_go_online(extension, monkeypatch):
    settings = bpy.context.scene.fruitlangs
    settings.config.embed.allow_download = True
    for online in (False, True):
        monkeypatch.setattr(conversions, "is_online", lambda allowed=online: allowed)
        assert conversions.read_config(settings).embed.allow_download is online


def test_zero_of_an_optional_number_means_not_given(extension):
    config = bpy.context.scene.fruitlangs.config
    assert conversions.read_config(bpy.context.scene.fruitlangs).count.diameter is None
    config.count.diameter = 0.08
    assert conversions.read_config(bpy.context.scene.fruitlangs).count.diameter == 0.08


def test_a_direction_of_zeros_means_not_given_and_another_arrives_as_typed(extension):
    scene = bpy.context.scene.fruitlangs.config.scene
    assert conversions.read_config(bpy.context.scene.fruitlangs).scene.up is None
    scene.up = (0.0, -0.6, 0.8)
    assert conversions.read_config(bpy.context.scene.fruitlangs).scene.up == (0.0, -0.6, 0.8)


def test_units_without_anything_typed_are_not_given_and_typed_ones_arrive(extension):
    units = bpy.context.scene.fruitlangs.config.units
    assert conversions.read_config(bpy.context.scene.fruitlangs).units == UnitsConfig()
    units.length, units.cameras = 2.5, "IMG_1.jpg, row/IMG_9.jpg"
    asked = UnitsConfig(length=2.5, cameras=("IMG_1.jpg", "row/IMG_9.jpg"))
    assert conversions.read_config(bpy.context.scene.fruitlangs).units == asked
    units.cameras, units.object = "", "bucket"
    assert conversions.read_config(bpy.context.scene.fruitlangs).units == UnitsConfig(length=2.5, object="bucket")
    units.object, units.points = "", (0, 0, 0.1, 0, 0, 1.2)
    asked = UnitsConfig(length=2.5, points=(0.0, 0.0, 0.1, 0.0, 0.0, 1.2))
    assert conversions.read_config(bpy.context.scene.fruitlangs).units == asked


def test_one_photo_where_two_are_asked_for_is_the_configs_own_error(extension):
    units = bpy.context.scene.fruitlangs.config.units
    units.length, units.cameras = 2.5, "IMG_1.jpg"
    with pytest.raises(ConfigError, match="Give the names of two photos"):
        conversions.read_config(bpy.context.scene.fruitlangs)


def test_the_tooltip_of_a_text_that_may_be_left_out_says_how(extension):
    properties = bpy.context.scene.fruitlangs.config.units.bl_rna.properties
    assert properties["object"].description.endswith("(empty means not given)")
    assert properties["cameras"].description.endswith("(empty means not given)")
    assert properties["points"].description.endswith("(0 means not given)")


def test_a_box_of_zeros_means_not_given_and_an_outline_is_typed_as_numbers(extension):
    count = bpy.context.scene.fruitlangs.config.count
    read = conversions.read_config(bpy.context.scene.fruitlangs).count
    assert (read.box, read.polygon, read.tree_places) == (None, None, None)
    count.polygon, count.tree_places = "0 0 0, 1.5 0 0, 1.5 2 0", "1 2 3"
    read = conversions.read_config(bpy.context.scene.fruitlangs).count
    assert (read.polygon, read.tree_places) == ((0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 1.5, 2.0, 0.0), (1.0, 2.0, 3.0))
    count.polygon, count.box = "", (0.0, 0.0, 0.1, 1.0, 1.0, 2.0)
    assert conversions.read_config(bpy.context.scene.fruitlangs).count.box == (0.0, 0.0, 0.1, 1.0, 1.0, 2.0)


def test_an_outline_that_is_no_numbers_is_the_configs_own_error(extension):
    bpy.context.scene.fruitlangs.config.count.polygon = "here 0 0"
    with pytest.raises(ConfigError, match=r"--count\.polygon is here 0 0"):
        conversions.read_config(bpy.context.scene.fruitlangs)


def test_a_senseless_value_is_the_configs_own_error(extension):
    bpy.context.scene.fruitlangs.config.count.threshold = 1.0
    with pytest.raises(ConfigError, match="threshold"):
        conversions.read_config(bpy.context.scene.fruitlangs)


@pytest.mark.parametrize("preset", list(PRESETS))
def test_a_preset_sets_training_as_it_does_on_the_command_line(extension, preset):
    settings = bpy.context.scene.fruitlangs
    settings.config.train.steps = 77
    settings.preset = preset
    assert conversions.read_config(settings).train == PRESETS[preset]


def test_settings_count_as_given_when_they_were_set_whatever_their_value(extension):
    settings = bpy.context.scene.fruitlangs
    assert conversions.list_given_settings(settings) == set()
    settings.config.train.steps = PRESETS["standard"].steps
    assert conversions.list_given_settings(settings) == {"train.steps"}
    settings.preset = "quick"
    assert conversions.list_given_settings(settings) == {"train.steps", "train.max_gaussians", "train.coarse_until"}
    settings.preset = "standard"
    assert conversions.list_given_settings(settings) == set()


def test_words_are_split_at_commas():
    assert conversions.read_words(" apple, red apple ,,") == ["apple", "red apple"]


def test_an_empty_prompt_is_an_error(extension):
    bpy.context.scene.fruitlangs.prompt = " , "
    with pytest.raises(VocabularyError, match="empty"):
        conversions.read_prompts(bpy.context.scene.fruitlangs)


def test_no_or_a_vanished_scene_folder_is_an_error(extension):
    settings = bpy.context.scene.fruitlangs
    with pytest.raises(SceneError, match="No scene is chosen"):
        conversions.source_folder(settings)
    settings.source = "/gone"
    with pytest.raises(SceneError, match="/gone does not exist"):
        conversions.source_folder(settings)
    settings.source = "//photos"
    with pytest.raises(SceneError, match="never saved"):
        conversions.source_folder(settings)


def test_a_ply_is_a_source_and_its_results_go_next_to_it(extension, tmp_path):
    (tmp_path / "tree.ply").write_bytes(b"ply")
    settings = bpy.context.scene.fruitlangs
    settings.source = str(tmp_path / "tree.ply")
    assert conversions.source_folder(settings) == tmp_path / "tree.ply"
    assert conversions.result_folder(settings) == tmp_path / "tree_fruit"


def test_paths_are_kept_relative_to_the_blend(extension, tmp_path):
    (tmp_path / "tree").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    settings = bpy.context.scene.fruitlangs
    settings.source = conversions.format_stored_path(tmp_path / "tree")
    assert settings.source == "//tree"
    assert conversions.source_folder(settings) == tmp_path / "tree"
    assert conversions.result_folder(settings) == tmp_path / "tree_fruit"


def test_results_go_next_to_the_scene_when_the_blend_was_never_saved(extension):
    settings = bpy.context.scene.fruitlangs
    settings.source = "/data/row7"
    assert conversions.result_folder(settings) == Path("/data/row7_fruit")
    settings.out = "/elsewhere/x"
    assert conversions.result_folder(settings) == Path("/elsewhere/x")
