"""What a run does to the folder it writes into: nothing of the user's goes, and nothing goes silently."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import filelock
import psutil
import pytest
from PIL import Image
from safetensors.torch import load_file

from fruitlangs.engine import pipeline
from fruitlangs.engine.config import Config, CountConfig, EmbedConfig, SceneConfig, TrainConfig, UnitsConfig
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.errors import Cancelled, ConfigError, OutputError, SceneError
from fruitlangs.engine.open_result import open_result
from fruitlangs.engine.pipeline import Result, count_scene
from fruitlangs.engine.result_folder import ResultFolder
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.training.checkpoint import read_checkpoint, training_key
from fruitlangs.engine.splatting.training.train import train
from fruitlangs.engine.storage import lock

NO_FRUIT_COUNT = FruitCount(fruits=[], audit=[], max_probability=0.0, mean_diameter=None)
NOTHING = CountConfig(threshold=0.999999)
"""No Gaussian is so certain, so the count has no notices of its own."""
TINY = Config(train=TrainConfig(steps=20, max_gaussians=3000, holdout_every=0))


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
    again = count_scene(copied, ["apple"], copied, config=Config(count=NOTHING))
    assert list((copied / "pictures").iterdir())
    assert again.notices == []


def test_a_result_that_is_moved_with_its_photos_finds_them_and_one_that_is_moved_alone_too(
    counted: Path, few_photos: Path, tmp_path: Path
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    photos = Path(shutil.copytree(few_photos, here / "photos"))
    folder = ResultFolder(Path(shutil.copytree(counted, here / "photos_fruit")))
    (folder.path / "cache" / "source.txt").write_text(folder.source_text(photos), encoding="utf-8")
    assert folder.source(folder.read(verify=False)) == photos
    here.rename(there)
    moved = ResultFolder(there / "photos_fruit")
    assert moved.source(moved.read(verify=False)) == there / "photos"
    alone = ResultFolder(there / "deep" / "photos_fruit")
    (alone.path / "cache").mkdir(parents=True)
    (alone.path / "cache" / "source.txt").write_text(alone.source_text(there / "photos"), encoding="utf-8")
    (there / "deep" / "photos_fruit").rename(tmp_path / "photos_fruit")
    alone = ResultFolder(tmp_path / "photos_fruit")
    assert alone.source(moved.read(verify=False)) == there / "photos"


def test_a_count_writes_both_ways_to_its_source(counted: Path, few_photos: Path) -> None:
    absolute, relative = (counted / "cache" / "source.txt").read_text(encoding="utf-8").splitlines()
    assert Path(absolute) == few_photos / "transforms.json"
    assert (counted / relative).resolve() == few_photos / "transforms.json"


def test_cameras_that_training_moved_are_those_of_the_next_prompt_too(few_photos: Path, tmp_path: Path) -> None:
    config = Config(train=TrainConfig(steps=20, max_gaussians=3000, holdout_every=0, refine_poses=True), count=NOTHING)
    first = count_scene(few_photos, ["fruit"], tmp_path, config=config)
    again = count_scene(tmp_path, ["apple"], tmp_path, config=Config(count=NOTHING))
    for ours, theirs in zip(again.scene.cameras, first.scene.cameras, strict=True):
        assert (ours.world_to_camera == theirs.world_to_camera).all()


def test_pictures_that_cannot_be_made_are_reported(copied: Path) -> None:
    content = json.loads((copied / "fruits.json").read_text())
    content["provenance"]["source"] = "/gone/photos"
    (copied / "fruits.json").write_text(json.dumps(content))
    again = count_scene(copied, ["apple"], copied, config=Config(count=NOTHING))
    assert list((copied / "pictures").iterdir()) == []
    assert again.notices == ["no pictures were made: The photos at /gone/photos are missing"]


def test_photos_that_have_changed_are_said_to_have_changed(copied: Path, few_photos: Path, tmp_path: Path) -> None:
    photos = shutil.copytree(few_photos, tmp_path / "photos")
    Image.new("RGB", (8, 8)).save(sorted(photos.glob("*.jpg"))[0])
    (copied / "cache" / "source.txt").write_text(str(photos / "transforms.json"))
    (notice,) = count_scene(copied, ["apple"], copied, config=Config(count=NOTHING)).notices
    assert "have changed since they were counted" in notice


def test_a_photo_that_cannot_be_read_is_named(copied: Path, few_photos: Path, tmp_path: Path) -> None:
    photos = shutil.copytree(few_photos, tmp_path / "photos")
    first = sorted(photos.glob("*.jpg"))[0]
    first.unlink()
    (copied / "cache" / "source.txt").write_text(str(photos / "transforms.json"))
    (notice,) = count_scene(copied, ["apple"], copied, config=Config(count=NOTHING)).notices
    assert first.name in notice


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


def test_what_killed_runs_left_is_removed(counted: Path, tmp_path: Path) -> None:
    left = tmp_path / "cache" / "publish-1234"
    left.mkdir(parents=True)
    (left / "fruits.csv").write_text("id\n")
    (tmp_path / "cache" / "spool").mkdir()
    count_scene(counted, ["apple"], tmp_path)
    assert sorted(path.name for path in (tmp_path / "cache").iterdir()) == ["lock", "lock-owner.txt", "source.txt"]


def contents(folder: Path) -> dict[str, bytes]:
    """What a reader of the result sees, by name."""
    files = [path for path in folder.rglob("*") if path.is_file() and "cache" not in path.relative_to(folder).parts]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def names_of_a_set(folder: Path) -> list[str]:
    return ["cache/source.txt", *ResultFolder(folder).list_files(), "fruits.json"]


def count_in_metres(folder: Path) -> Result:
    """Count again with another unit: no file of lengths is of use without the others."""
    metres = Config(units=UnitsConfig(metres_per_unit=0.5))
    return count_scene(folder, ["apple"], folder, config=metres, writers={"scene.blend": write_blend})


@pytest.mark.parametrize(("always", "link"), [(True, True), (False, False)], ids=["locked", "once, no hard links"])
def test_where_any_file_cannot_be_replaced_the_whole_earlier_result_stays(
    copied: Path, monkeypatch: pytest.MonkeyPatch, always: bool, link: bool
) -> None:
    before, replace = contents(copied), os.replace
    refused: list[str] = []

    def refuse(source: Path, target: Path) -> None:
        if Path(target) == copied / name and (always or not refused):
            refused.append(name)
            raise PermissionError(13, "The process cannot access the file", str(source), None, str(target))
        replace(source, target)

    def no_links(source: Path, target: Path) -> None:
        raise OSError(1, "Operation not permitted")

    if not link:
        monkeypatch.setattr(os, "link", no_links)
    monkeypatch.setattr(os, "replace", refuse)
    monkeypatch.setattr(pipeline, "count_prompts", lambda *_, **__: NO_FRUIT_COUNT)
    for name in names_of_a_set(copied):
        refused.clear()
        with pytest.raises(OutputError, match=f"{re.escape(Path(name).name)} cannot be replaced .* result stays"):
            count_in_metres(copied)
        assert refused
        assert contents(copied) == before, name
    assert ResultFolder(copied).read()["metres_per_unit"] is None


def test_a_run_killed_between_any_two_files_leaves_the_earlier_result(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, replace = contents(copied), os.replace

    class Killed(BaseException):
        pass

    def die(source: Path, target: Path) -> None:
        if Path(target) == copied / name:
            raise Killed
        replace(source, target)

    monkeypatch.setattr(pipeline, "count_prompts", lambda *_, **__: NO_FRUIT_COUNT)
    for name in names_of_a_set(copied):
        monkeypatch.setattr(os, "replace", die)
        with pytest.raises(Killed):
            count_in_metres(copied)
        monkeypatch.setattr(os, "replace", replace)
        assert ResultFolder(copied).read()["metres_per_unit"] is None
        assert contents(copied) == before, name


HOLD = """
import sys, time
sys.path.insert(0, sys.argv[1])
import _checkout
from pathlib import Path
from fruitlangs.engine.result_folder import ResultFolder
with ResultFolder(Path(sys.argv[2])).lock():
    print("holds it", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that writes to `tmp_path`."""
    scripts = str(Path(__file__).resolve().parents[2] / "scripts")
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, scripts, str(tmp_path)], stdout=subprocess.PIPE, encoding="utf-8"
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "holds it\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_run_into_one_folder_ends_with_a_sentence_that_names_the_first(
    counted: Path, tmp_path: Path, holder: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "PATIENCE", 0.2)
    with pytest.raises(OutputError, match=rf"in use by process {holder.pid} on .* since 20.*choose another --out"):
        count_scene(counted, ["apple"], tmp_path)
    holder.kill()
    holder.wait()
    assert count_scene(counted, ["apple"], tmp_path).files


def test_a_file_system_without_locks_still_keeps_a_second_run_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class NoLocks(filelock.FileLock):
        def _acquire(self) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(lock, "_LOCKS", ((NoLocks, "lock"), *lock._LOCKS[1:]))
    monkeypatch.setattr(lock, "PATIENCE", 0.2)
    folder = ResultFolder(tmp_path)
    with folder.lock(), pytest.raises(OutputError, match="in use by process"), folder.lock():
        pass
    with folder.lock():
        pass


def test_a_run_may_not_write_into_a_folder_it_is_writing_to_in_another_thread(
    counted: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock, "PATIENCE", 0.2)
    with ResultFolder(tmp_path).lock(), ThreadPoolExecutor() as pool:
        second = pool.submit(count_scene, counted, ["apple"], tmp_path)
        with pytest.raises(OutputError, match=f"in use by process {os.getpid()} on"):
            second.result()


def mapped(folder: Path) -> list[str]:
    """The files below a folder that this process has mapped."""
    return [entry.path for entry in psutil.Process().memory_maps() if entry.path.startswith(str(folder))]


@pytest.mark.skipif(not hasattr(psutil.Process, "memory_maps"), reason="this system does not tell")
def test_no_file_that_may_be_replaced_stays_mapped(copied: Path, few_photos: Path, tmp_path: Path) -> None:
    again = count_scene(copied, ["apple"], copied)
    opened = open_result(copied)
    assert mapped(copied) == []
    features = load_file(copied / "features.safetensors")
    assert mapped(copied) != []  # what the others must not do
    assert len(features["vectors"]) == len(again.features) == len(opened.features)

    def stop(fraction: float, message: str) -> None:
        if checkpoint.is_file():
            raise Cancelled

    config = Config(train=TrainConfig(steps=20, max_gaussians=3000, holdout_every=0, checkpoint_every=5))
    scene = read_scene(few_photos)
    checkpoint = tmp_path / "checkpoint.safetensors"
    with pytest.raises(Cancelled):
        train(scene, config.train, checkpoint=checkpoint, progress=stop)
    state = read_checkpoint(checkpoint, training_key(scene, config.train))
    assert state.step > 0
    assert mapped(tmp_path) == [str(copied / "features.safetensors")]


def test_a_setting_that_was_given_must_be_that_of_the_earlier_result(copied: Path) -> None:
    usual = TrainConfig().steps
    with pytest.raises(ConfigError, match=rf"made with --train\.steps 20, not {usual}\."):
        count_scene(copied, ["apple"], copied, given={"train.steps"})
    with pytest.raises(ConfigError, match=r"made with --scene\.max-side 1600, not 800\."):
        count_scene(copied, ["apple"], copied, config=Config(scene=SceneConfig(max_side=800)))


@pytest.mark.parametrize(
    "given", [set(), {"train.checkpoint_every"}, {"scene.up"}, {"count.threshold"}, {"embed.clip"}]
)
def test_what_was_not_given_or_does_not_change_a_result_is_taken_from_the_earlier_one(
    copied: Path, given: set[str]
) -> None:
    config = Config(train=TrainConfig(checkpoint_every=77), embed=EmbedConfig(clip="elsewhere"))
    assert count_scene(copied, ["apple"], copied, config=config, given=given).config.train.steps == 20


def test_checkpoints_at_other_steps_do_not_train_again(few_photos: Path, tmp_path: Path) -> None:
    count_scene(few_photos, ["fruit"], tmp_path, config=TINY)
    often = Config(train=dataclasses.replace(TINY.train, checkpoint_every=3))
    assert "train" in count_scene(few_photos, ["fruit"], tmp_path, config=often).reused


def test_the_provenance_names_the_version_of_fruitlangs(counted: Path) -> None:
    import fruitlangs

    versions = json.loads((counted / "fruits.json").read_text())["provenance"]["versions"]
    assert versions["fruitlangs"] == fruitlangs.__version__
