"""What a run does to the folder it writes into: nothing of the user's goes, and nothing goes silently."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from fruitlangs.engine.config import Config, CountConfig, TrainConfig
from fruitlangs.engine.errors import OutputError, SceneError
from fruitlangs.engine.pipeline import Result, count_scene

TINY = Config(train=TrainConfig(steps=20, max_gaussians=3000))


def write_blend(path: Path, result: Result) -> None:
    path.write_bytes(b"ours")


@pytest.fixture(scope="module")
def counted(few_photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result folder with a scene.blend of its own, made of the transforms.json itself."""
    out = tmp_path_factory.mktemp("counted")
    count_scene(few_photos / "transforms.json", ["fruit"], out, config=TINY, writers={"scene.blend": write_blend})
    return out


@pytest.fixture
def copied(counted: Path, tmp_path: Path) -> Path:
    """A copy of the result with nothing in its cache but where the photos are."""
    copy = shutil.copytree(counted, tmp_path / "copied", ignore=shutil.ignore_patterns("cache"))
    (copy / "cache").mkdir()
    shutil.copy(counted / "cache" / "source.txt", copy / "cache")
    return copy


def test_a_result_of_a_transforms_file_finds_its_photos_again(copied: Path) -> None:
    again = count_scene(copied, ["apple"], copied)
    assert list((copied / "pictures").iterdir())
    assert again.notices == []


def test_cameras_that_training_moved_are_those_of_the_next_prompt_too(few_photos: Path, tmp_path: Path) -> None:
    nothing = CountConfig(threshold=0.999999)
    config = Config(train=TrainConfig(steps=20, max_gaussians=3000, refine_poses=True), count=nothing)
    first = count_scene(few_photos, ["fruit"], tmp_path, config=config)
    again = count_scene(tmp_path, ["apple"], tmp_path, config=Config(count=nothing))
    for ours, theirs in zip(again.scene.cameras, first.scene.cameras, strict=True):
        assert (ours.world_to_camera == theirs.world_to_camera).all()


def test_pictures_that_cannot_be_made_are_reported(copied: Path) -> None:
    content = json.loads((copied / "fruits.json").read_text())
    content["provenance"]["source"] = "/gone/photos"
    (copied / "fruits.json").write_text(json.dumps(content))
    again = count_scene(copied, ["apple"], copied)
    assert list((copied / "pictures").iterdir()) == []
    assert again.notices == ["the photos at /gone/photos are missing or have changed, so no pictures were made"]


def test_a_blend_of_the_earlier_result_goes_with_it(copied: Path) -> None:
    count_scene(copied, ["apple"], copied)
    assert not (copied / "scene.blend").exists()


def test_the_blend_that_is_open_stays(copied: Path) -> None:
    count_scene(copied, ["apple"], copied, keep=copied / "scene.blend")
    assert (copied / "scene.blend").read_bytes() == b"ours"


def test_a_blend_that_no_run_wrote_stays(counted: Path, tmp_path: Path) -> None:
    (tmp_path / "scene.blend").write_bytes(b"the user's")
    count_scene(counted, ["apple"], tmp_path)
    count_scene(counted, ["fruit"], tmp_path)
    assert (tmp_path / "scene.blend").read_bytes() == b"the user's"


@pytest.mark.parametrize("name", ["", "transforms.json"])
def test_the_folder_of_the_photos_is_no_place_for_results(few_photos: Path, name: str) -> None:
    before = sorted(few_photos.iterdir())
    with pytest.raises(OutputError, match="folder of the scene itself"):
        count_scene(few_photos / name, ["apple"], few_photos, config=TINY)
    assert sorted(few_photos.iterdir()) == before


def test_a_scene_that_is_not_there_leaves_no_output_folder(tmp_path: Path) -> None:
    with pytest.raises(SceneError):
        count_scene(tmp_path / "missing", ["apple"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_killed_runs_left_is_removed_and_a_running_one_is_not_disturbed(counted: Path, tmp_path: Path) -> None:
    dead, alive = (tmp_path / "cache" / f"publish-{number}" for number in (111111111, 222222222))
    for folder in (dead, alive):
        folder.mkdir(parents=True)
        (folder / "fruits.csv").write_text("id\n")
    os.utime(dead, (0, 0))
    count_scene(counted, ["apple"], tmp_path)
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == [alive.name, "source.txt"]


def test_the_provenance_names_the_version_of_fruitlangs(counted: Path) -> None:
    import fruitlangs

    versions = json.loads((counted / "fruits.json").read_text())["provenance"]["versions"]
    assert versions["fruitlangs"] == fruitlangs.__version__
