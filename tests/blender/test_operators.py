from __future__ import annotations

import dataclasses
import importlib
import shutil
import sys
import types
from pathlib import Path

import bpy
import pytest
from blender_examples import drawn

from fruitlangs.engine.config import UnitsConfig
from fruitlangs.engine.errors import SceneError
from fruitlangs.fruitlangs_addon.panels.step_scene import FRUITLANGS_PT_scene
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, get_attribute
from fruitlangs.operators.settings.settings import is_of_another, result_folder
from fruitlangs.operators.steps import import_scene
from fruitlangs.operators.steps.show_result import show_reconstruction, show_result


@pytest.fixture
def engine(monkeypatch, counted, result_of):
    """In place of the engine's two slow functions: what they were called with, and a result at once."""
    calls = types.SimpleNamespace(read=[], count=[], error=None, notices=[])

    class Source:
        notices = ()

        def __init__(self, path):
            self.path = path

        def is_alone(self):
            return False

        def read(self, config, progress):
            calls.read.append((self.path, config))
            if calls.error:
                raise calls.error
            return counted.scene

        def open(self):
            return types.SimpleNamespace(notices=calls.notices)

    def count_scene(source, prompts, out, **options):
        calls.count.append((source, prompts, out, options))
        if calls.error:
            raise calls.error
        return result_of(counted, out)

    importlib.import_module("fruitlangs.engine.pipeline")  # what imports the real ones has them before these stand in
    source = types.SimpleNamespace(Source=Source)
    pipeline = types.SimpleNamespace(count_scene=count_scene)
    monkeypatch.setitem(sys.modules, "fruitlangs.engine.scene.source", source)
    monkeypatch.setitem(sys.modules, "fruitlangs.engine.pipeline", pipeline)
    return calls


@pytest.fixture
def settings(extension, tmp_path):
    (tmp_path / "tree").mkdir()
    settings = bpy.context.scene.fruitlangs
    settings.source = str(tmp_path / "tree")
    return settings


def from_source(result, source):
    return dataclasses.replace(result, origin={**result.origin, "source": str(source)})


def test_import_shows_cameras_and_points(engine, settings, tmp_path):
    assert bpy.ops.fruitlangs.import_scene() == {"FINISHED"}
    assert engine.read[0][0] == tmp_path / "tree"
    assert len(bpy.data.collections["Cameras"].objects) == 6
    assert len(bpy.data.objects["Sparse points"].data.vertices) == 200
    assert (settings.result.cameras, settings.result.points) == (6, 200)


def test_import_shows_the_messages_about_the_photos(engine, settings):
    engine.notices = ["2 of the 8 photos that transforms.json lists are missing and were left out: a.jpg, b.jpg"]
    bpy.ops.fruitlangs.import_scene()
    assert settings.result.notices == engine.notices[0]


def test_import_of_a_video_shows_how_many_stills_were_chosen(engine, settings, monkeypatch, tmp_path, counted):
    video, notice = tmp_path / "walk.mp4", "6 stills were chosen from walk.mp4"
    video.touch()
    posed = import_scene.PosedScene(counted.scene, [notice])
    monkeypatch.setattr(import_scene, "read_posed", lambda path, out, *_: posed if path == video else None)
    assert bpy.ops.fruitlangs.import_scene(filepath=str(video)) == {"FINISHED"}
    assert settings.result.notices == notice
    assert Path(settings.source) == video
    assert "Video: Import Scene chooses stills" in drawn(FRUITLANGS_PT_scene).text


def test_the_result_of_a_video_is_next_to_it_without_its_suffix(settings, tmp_path):
    (tmp_path / "walk.MP4").touch()
    settings.source = str(tmp_path / "walk.MP4")
    assert result_folder(settings) == tmp_path / "walk_fruit"


def test_import_of_a_given_folder_keeps_it_in_the_scene(engine, extension, tmp_path):
    bpy.ops.fruitlangs.import_scene(directory=str(tmp_path))
    assert Path(bpy.context.scene.fruitlangs.source) == tmp_path


@pytest.mark.parametrize(
    ("file", "chosen"),
    [
        ("", "scene"),
        ("tree.ply", "scene/tree.ply"),
        ("TREE.PLY", "scene/TREE.PLY"),
        ("a.jpg", "scene"),
        ("a.MOV", "scene/a.MOV"),
    ],
)
def test_a_folder_or_a_ply_in_it_is_what_the_dialog_chooses(engine, extension, tmp_path, monkeypatch, file, chosen):
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / file).touch()
    monkeypatch.setattr(import_scene, "read_cloud", lambda source, *_: None)
    monkeypatch.setattr(import_scene.FRUITLANGS_OT_import_scene, "_show_reconstruction", lambda *_: None)
    bpy.ops.fruitlangs.import_scene(directory=f"{folder}/", filepath=f"{folder}/{file}")
    assert Path(bpy.context.scene.fruitlangs.source) == tmp_path / chosen


@pytest.mark.parametrize(
    ("ask", "chosen", "source", "asks"),
    [(True, "", "scene", True), (False, "", "scene", False), (False, "", "", True), (True, "tree.ply", "scene", False)],
)
def test_only_the_menu_asks_where_a_scene_is_set(settings, ask, chosen, source, asks):
    settings.source = source
    item = types.SimpleNamespace(ask=ask, chosen=chosen)
    assert import_scene.FRUITLANGS_OT_import_scene.must_ask(item, settings) == asks


def test_the_entry_of_the_menu_asks(extension):
    made = types.SimpleNamespace(ask=False)
    layout = types.SimpleNamespace(operator=lambda name, text: made)
    import_scene.menu_entry(types.SimpleNamespace(layout=layout), bpy.context)
    assert made.ask


def test_count_passes_the_panels_settings_and_shows_the_result(engine, settings, tmp_path):
    settings.prompt, settings.negative, settings.config.train.steps = "apple, pear", "leaf", 9
    assert bpy.ops.fruitlangs.count() == {"FINISHED"}
    source, prompts, out, options = engine.count[0]
    assert (source, prompts, out) == (tmp_path / "tree", ["apple", "pear"], tmp_path / "tree_fruit")
    assert options["negatives"] == ["leaf"]
    assert options["config"].train.steps == 9
    assert len(bpy.data.collections["Fruits"].objects) == 3
    result = settings.result
    assert (result.count, result.label, result.unit) == (3, "apple", "scene units")
    assert result.mean_diameter == pytest.approx(0.2)
    assert result.whereabouts == "hanging or fallen: unknown, because no ground was found"
    assert result.notices == "no pictures"
    assert bpy.context.scene["fruitlangs_set_id"] == "f00"
    assert options["keep"] is None


def test_a_count_goes_on_where_the_last_one_was_wherever_the_file_is_saved_since(engine, settings, tmp_path):
    (tmp_path / "tree_fruit").mkdir()
    bpy.ops.fruitlangs.count()
    (tmp_path / "work").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "work" / "a.blend"))
    bpy.ops.fruitlangs.count()
    assert engine.count[1][2] == tmp_path / "tree_fruit"
    (tmp_path / "tree_fruit").rmdir()
    bpy.ops.fruitlangs.count()
    assert engine.count[2][2] == tmp_path / "work" / "tree_fruit"


def test_a_count_of_another_source_is_not_measured_by_the_first_ones_measures(engine, settings, tmp_path):
    settings.result.source, bpy.context.scene["fruitlangs_ground"] = str(tmp_path / "other"), [0.0, 0.0, 1.0]
    config = settings.config
    config.units.points, config.units.length, config.scene.up = (0, 0, 0, 0, 0, 1), 2.0, (0, 0, 1)
    config.count.diameter, config.count.threshold = 0.1, 0.3
    bpy.ops.fruitlangs.count()
    asked = engine.count[0][3]["config"]
    assert (asked.units, asked.scene.up) == (UnitsConfig(), None)
    assert (asked.count.diameter, asked.count.threshold) == (None, 0.3)


def test_import_of_another_source_takes_the_first_one_away_and_says_so(
    engine, settings, counted, result_of, tmp_path, capfd
):
    scene = bpy.context.scene
    first = result_of(counted, tmp_path / "out")
    (tmp_path / "row 2").mkdir()
    show_result(bpy.context, scene, from_source(first, tmp_path / "tree"))
    bpy.ops.fruitlangs.add_region()
    bpy.ops.fruitlangs.set_length(points=(0, 0, 0, 0, 0, 1), length=0.5)
    bpy.ops.fruitlangs.set_ground(points=(0, 0, 0, 1, 0, 0, 0, 1, 0))
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    settings.source = str(tmp_path / "row 2")
    bpy.ops.fruitlangs.import_scene()
    assert "scale, ground and region of" in capfd.readouterr().out
    bpy.ops.fruitlangs.import_scene()
    told = drawn(FRUITLANGS_PT_scene).text
    assert "1 decision on" in told
    assert "is kept until it is shown again" in told
    assert "scale, ground and region of" in told
    for role in ("gaussians", "fruit", "region"):
        assert find_owned_objects(scene, role) == []
    assert len(find_owned_objects(scene, "camera")) == 6
    assert (settings.result.count, settings.answer.text, len(settings.review.log)) == (-1, "", 0)
    assert settings.config.units.length == 0.0
    assert not any(settings.config.units.points)
    assert not any(settings.config.scene.up)
    assert "fruitlangs_ground" not in scene
    assert find_owned_object(scene, "root")["metres_per_unit"] == 0.0


def test_decisions_wait_while_another_source_is_shown(engine, settings, counted, result_of, tmp_path):
    scene = bpy.context.scene
    first, second = (from_source(result_of(counted, tmp_path / name), tmp_path / name) for name in ("tree", "row 2"))
    show_result(bpy.context, scene, first)
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    show_result(bpy.context, scene, second)
    assert len(find_owned_objects(scene, "fruit")) == 3
    assert "is kept until it is shown again" in settings.result.notices
    show_result(bpy.context, scene, first)
    assert len(find_owned_objects(scene, "fruit")) == 4
    assert len(settings.review.log) == 1


def test_an_earlier_result_of_a_source_is_the_same_scene(settings, counted_balls, tmp_path):
    folder = shutil.copytree(counted_balls.out, tmp_path / "balls_fruit")
    bpy.ops.fruitlangs.import_scene(directory=str(folder))
    assert not is_of_another(settings, folder)
    assert not is_of_another(settings, Path(counted_balls.origin["source"]))
    assert is_of_another(settings, tmp_path / "tree")


def photos_of(folder, look):
    """A folder with photos of a tree of that look, which are named as every camera names them."""
    (folder / "images").mkdir(parents=True)
    for number in range(3):
        (folder / "images" / f"IMG_{number}.jpg").write_bytes(f"{look} {number}".encode())
    return folder


@pytest.fixture
def reviewed(engine, settings, counted, result_of, tmp_path):
    """A tree in before/photos that was counted, measured and reviewed."""
    source = photos_of(tmp_path / "before" / "photos", "red")
    show_result(bpy.context, bpy.context.scene, from_source(result_of(counted, tmp_path / "out"), source))
    bpy.ops.fruitlangs.set_length(points=(0, 0, 0, 0, 0, 1), length=0.5)
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    return source


def test_a_scene_whose_folder_was_moved_with_its_photos_is_the_same(reviewed, settings, tmp_path):
    settings.source = str(shutil.move(reviewed.parent, tmp_path / "elsewhere") / "photos")
    bpy.ops.fruitlangs.import_scene()
    assert settings.result.count == 3
    assert len(settings.review.log) == 1
    assert settings.config.units.length == 0.5


def test_another_tree_in_a_folder_of_the_same_name_takes_nothing_of_the_first(reviewed, settings, tmp_path):
    shutil.move(reviewed.parent, tmp_path / "archive")
    settings.source = str(photos_of(tmp_path / "next" / "photos", "green"))
    bpy.ops.fruitlangs.import_scene()
    assert settings.result.count == -1
    assert len(settings.review.log) == 0
    assert settings.config.units.length == 0.0


def test_decisions_that_waited_find_their_source_where_it_was_moved(reviewed, settings, tmp_path):
    settings.source = str(photos_of(tmp_path / "next" / "photos", "green"))
    bpy.ops.fruitlangs.import_scene()
    assert len(settings.review.log) == 0
    settings.source = str(shutil.move(reviewed.parent, tmp_path / "archive") / "photos")
    bpy.ops.fruitlangs.import_scene()
    assert len(settings.review.log) == 1


def test_a_copy_of_a_scene_next_to_the_first_is_another(reviewed, settings, tmp_path):
    assert is_of_another(settings, shutil.copytree(reviewed, tmp_path / "copy" / "photos"))


def test_import_of_the_same_source_keeps_the_count_and_its_scale(engine, settings, counted_with, result_of, tmp_path):
    scene = bpy.context.scene
    result = result_of(counted_with(metres_per_unit=0.4), tmp_path / "out")
    show_result(bpy.context, scene, from_source(result, tmp_path / "tree"))
    bpy.ops.fruitlangs.import_scene()
    assert settings.result.count == len(find_owned_objects(scene, "fruit")) == 3
    assert find_owned_object(scene, "root")["metres_per_unit"] == pytest.approx(0.4)


@pytest.fixture
def reconstruct(engine, settings, counted):
    """Show a reconstruction with these Gaussians and this scale, as Reconstruct does."""

    def reconstruct(scale=None, gaussians=counted.gaussians):
        origin = {"training": {"psnr": None, "ssim": None}}
        made = types.SimpleNamespace(
            scene=dataclasses.replace(counted.scene, metres_per_unit=scale),
            gaussians=gaussians,
            origin=origin,
            files=types.SimpleNamespace(features=Path("features.safetensors")),
        )
        show_reconstruction(bpy.context, bpy.context.scene, made, types.SimpleNamespace(notices=[]))

    return reconstruct


def test_reconstructing_the_same_gaussians_keeps_the_count_and_whose_they_are(reconstruct, settings):
    bpy.ops.fruitlangs.count()
    reconstruct()
    ids = get_attribute(find_owned_object(bpy.context.scene, "gaussians").data, "fruit_id")
    assert ids[:6].tolist() == [1, 1, 2, 2, 3, 3]
    assert settings.result.count == 3


@pytest.mark.parametrize("other", ["scale", "gaussians"])
def test_reconstructing_others_takes_the_count_away_and_says_so(reconstruct, settings, counted, other):
    bpy.ops.fruitlangs.count()
    means = counted.gaussians.means + (1.0 if other == "gaussians" else 0.0)
    reconstruct(0.4 if other == "scale" else None, dataclasses.replace(counted.gaussians, means=means))
    assert find_owned_objects(bpy.context.scene, "fruit") == []
    assert settings.result.count == -1
    assert "Count again" in settings.result.notices


def test_a_count_of_nothing_goes_with_its_gaussians_too(
    reconstruct, settings, counted, counted_with, result_of, tmp_path
):
    show_result(bpy.context, bpy.context.scene, result_of(counted_with(fruits=0), tmp_path))
    reconstruct(gaussians=dataclasses.replace(counted.gaussians, means=counted.gaussians.means + 1.0))
    assert settings.result.count == -1


def test_sizes_are_shown_in_millimetres_where_the_scale_is_known(engine, settings, counted_with, result_of):
    from fruitlangs.operators.steps.show_result import keep_result, report_line

    result = result_of(counted_with(metres_per_unit=0.4), Path("/out"))
    keep_result(settings, result)
    assert settings.result.unit == "mm"
    assert report_line(settings.result) == "apple: 3, mean diameter 80 mm"
    keep_result(settings, dataclasses.replace(result, scene=counted_with().scene))
    assert report_line(settings.result) == "apple: 3, mean diameter 0.2 scene units"


def test_a_count_whose_fruit_may_be_taken_for_other_kinds_is_a_warning(settings, counted_with, result_of, tmp_path):
    from fruitlangs.operators.steps.show_result import make_count_report

    for fruits, end in ((0, "0, the 38 fruit that were found look like other kinds"), (2, "; 38 other fruit look")):
        counted = result_of(counted_with(fruits=fruits), tmp_path)
        show_result(bpy.context, bpy.context.scene, counted)
        assert make_count_report(settings.result, counted.fruit_count)[0] == {"INFO"}
        uncertain = dataclasses.replace(counted.fruit_count, other_fruit=38)
        show_result(bpy.context, bpy.context.scene, dataclasses.replace(counted, fruit_count=uncertain))
        level, text = make_count_report(settings.result, uncertain)
        assert level == {"WARNING"}
        assert end in text


def test_a_count_never_removes_the_open_file(engine, settings, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.fruitlangs.count()
    assert engine.count[0][3]["keep"] == tmp_path / "scene.blend"


def test_a_count_without_fruit_is_a_counted_zero(engine, settings, counted_with, result_of, monkeypatch):
    none = counted_with(fruits=0)
    monkeypatch.setattr(
        sys.modules["fruitlangs.engine.pipeline"],
        "count_scene",
        lambda source, prompts, out, **_: result_of(
            none, out, fruit_count=dataclasses.replace(none.fruit_count, max_probability=0.3)
        ),
    )
    bpy.ops.fruitlangs.count()
    assert (settings.result.count, settings.result.label) == (0, "apple")
    assert "reached the threshold" in settings.result.zero_reason


def test_a_failure_is_a_report_and_leaves_the_last_result(engine, settings):
    bpy.ops.fruitlangs.count()
    engine.error = SceneError("photo 7 is gone. Put it back")
    with pytest.raises(RuntimeError, match="photo 7 is gone"):
        bpy.ops.fruitlangs.count()
    assert (settings.error, settings.failed) == ("photo 7 is gone. Put it back", "Count")
    assert settings.result.count == 3
    assert len(bpy.data.collections["Fruits"].objects) == 3


def test_a_failure_never_becomes_a_count(engine, settings):
    engine.error = ZeroDivisionError("boom")
    with pytest.raises(RuntimeError, match="boom"):
        bpy.ops.fruitlangs.count()
    assert settings.result.count == -1
    assert len(bpy.data.objects) == 0


def test_a_missing_package_is_a_report_that_names_it(engine, settings):
    engine.error = ModuleNotFoundError("No module named 'torch'")
    with pytest.raises(RuntimeError, match="torch"):
        bpy.ops.fruitlangs.count()


def test_a_success_clears_the_last_error(engine, settings):
    settings.error, settings.failed = "old", "Count"
    bpy.ops.fruitlangs.count()
    assert (settings.error, settings.failed) == ("", "")


def test_count_wants_a_scene_and_a_prompt(engine, extension, tmp_path):
    settings = bpy.context.scene.fruitlangs
    assert not bpy.ops.fruitlangs.count.poll()
    settings.source = str(tmp_path)
    assert bpy.ops.fruitlangs.count.poll()
    settings.prompt = " , "
    assert not bpy.ops.fruitlangs.count.poll()


def test_a_folder_that_vanished_is_a_report(engine, settings, tmp_path):
    (tmp_path / "tree").rmdir()
    with pytest.raises(RuntimeError, match="does not exist"):
        bpy.ops.fruitlangs.import_scene()


def test_a_scene_deleted_meanwhile_is_named_and_nothing_is_lost(extension, counted):
    from fruitlangs.engine.errors import OutputError
    from fruitlangs.operators.jobs.target_scene import Target

    other = bpy.data.scenes.new("Row 7")
    target = Target(other)
    other.name = "Row 8"
    assert target.scene(bpy.context) == other
    bpy.data.scenes.remove(other)
    with pytest.raises(OutputError, match="Row 7 was deleted"):
        target.scene(bpy.context)


def test_missing_packages_are_named_with_a_command_that_keeps_blenders_numpy(extension, monkeypatch):
    from fruitlangs.operators.packages import dependencies

    assert dependencies.find_missing_packages() == []
    monkeypatch.setitem(dependencies.REQUIRED, "no_such_module", "no-such-package")
    missing = dependencies.find_missing_packages()
    assert missing == ["no-such-package"]
    command = dependencies.make_install_command(missing)
    if bpy.app.binary_path:
        assert command.endswith('bpy.ops.fruitlangs.install_dependencies()"')
    else:
        assert "-m pip install no-such-package numpy==" in command
