"""A video is counted like photos, and its result is counted again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from bumpy_wall import WIDTH, pass_by, render
from films import write_film

from fruitlangs.engine.config import Config, CountConfig, PhotosConfig, TrainConfig
from fruitlangs.engine.errors import ConfigError, SceneError
from fruitlangs.engine.pipeline import Result, count_scene
from fruitlangs.engine.scene.source import Source

VIEWS = 6
CONFIG = Config(train=TrainConfig(steps=20, max_gaussians=3000, holdout_every=0), count=CountConfig(threshold=0.9))


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video that rests at each of six places."""
    slides = [np.asarray(pass_by(view)) for view in range(VIEWS)]
    return write_film(tmp_path_factory.mktemp("film") / "wall.mp4", [slide for slide in slides for _ in range(6)])


@pytest.fixture(scope="module")
def counted(film: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return count_scene(film, ["fruit"], tmp_path_factory.mktemp("out"), config=CONFIG)


def test_a_video_is_counted_with_its_stills_as_photos(film: Path, counted: Result) -> None:
    (stills,) = counted.out.glob("cache/video-*/images")
    names = [photo.name for photo in counted.scene.images]
    assert names == sorted(file.name for file in stills.iterdir())
    assert len(names) == VIEWS
    assert counted.scene.cameras[0].width == pytest.approx(WIDTH, abs=4)
    document = json.loads((counted.out / "fruits.json").read_text(encoding="utf-8"))
    assert document["provenance"]["source"] == "wall.mp4"
    notice = next(notice for notice in counted.notices if "stills" in notice)
    assert notice == f"6 stills were chosen from wall.mp4 (1 s); they are in cache/{stills.parent.name}"


def test_a_second_run_reuses_stills_cameras_and_training(film: Path, counted: Result, tmp_path: Path) -> None:
    shutil.copytree(counted.out / "cache", tmp_path / "cache")
    again = count_scene(film, ["fruit"], tmp_path, config=CONFIG)
    assert {"photos", "train"} <= set(again.reused)
    assert again.origin["inputs_sha256"] == counted.origin["inputs_sha256"]
    assert [notice for notice in again.notices if "stills" in notice]


@pytest.mark.parametrize("deleted", [False, True])
def test_the_result_of_a_video_is_counted_again_with_pictures(counted: Result, deleted: bool, tmp_path: Path) -> None:
    first = shutil.copytree(counted.out, tmp_path / "first")
    if deleted:
        for stills in first.glob("cache/video-*"):
            shutil.rmtree(stills)
    second = count_scene(first, ["leaf"], tmp_path / "second", config=CONFIG)
    third = count_scene(second.out, ["apple"], tmp_path / "third", config=CONFIG)
    assert second.notices == third.notices == []
    assert len(list((third.out / "pictures").iterdir())) == 4
    assert list((third.out / "cache").glob("video-*/stills.json"))


def test_a_video_that_is_gone_is_a_notice_and_not_an_error(counted: Result, tmp_path: Path) -> None:
    first = shutil.copytree(counted.out, tmp_path / "first")
    (first / "cache" / "source.txt").write_text(str(tmp_path / "gone.mp4"), encoding="utf-8")
    again = count_scene(first, ["leaf"], tmp_path / "second", config=CONFIG)
    assert [notice for notice in again.notices if "gone.mp4 are missing" in notice or "gone.mp4 is missing" in notice]


def test_a_bad_video_leaves_no_result(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"not a video")
    with pytest.raises(SceneError, match=r"a\.mp4 cannot be read as a video"):
        count_scene(tmp_path / "a.mp4", ["fruit"], tmp_path / "out", config=CONFIG)
    assert not (tmp_path / "out" / "fruits.json").exists()


def test_a_raw_file_next_to_its_jpeg_is_left_out_with_a_notice(tmp_path: Path) -> None:
    (tmp_path / "wall").mkdir()
    for view in range(VIEWS):
        render(view).save(tmp_path / "wall" / f"{view}.png")
    (tmp_path / "wall" / "3.DNG").write_bytes(b"raw")
    found = Source(path=tmp_path / "wall").find_poses(tmp_path / "cache", PhotosConfig())
    assert found.notices == ["1 RAW file was left out, because a photo of the same name is there"]


def test_imported_gaussians_with_a_video_are_an_error(film: Path, tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_bytes(b"ply")
    with pytest.raises((SceneError, ConfigError), match=r"wall\.mp4 is a video without cameras"):
        count_scene(film, ["fruit"], tmp_path / "out", imported=tmp_path / "a.ply", config=CONFIG)
