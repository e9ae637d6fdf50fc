"""Cameras from photos alone, by pycolmap on small pictures of a textured ball."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import types
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bumpy_wall import FOCAL, HEIGHT, WIDTH, center, render
from PIL import Image

from fruitlangs.engine import child_process
from fruitlangs.engine.config import Config, CountConfig, PhotosConfig, SceneConfig, TrainConfig
from fruitlangs.engine.errors import Cancelled, SceneError
from fruitlangs.engine.pipeline import count_scene
from fruitlangs.engine.scene import source
from fruitlangs.engine.scene.alignment import align
from fruitlangs.engine.scene.formats import colmap, layout
from fruitlangs.engine.scene.formats.cameras_json import dump_cameras
from fruitlangs.engine.scene.formats.colmap_records import check_records
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm import placing
from fruitlangs.engine.scene.sfm.find_cameras import find_poses
from fruitlangs.engine.scene.sfm.job import Copy, Job
from fruitlangs.engine.scene.sfm.mapping import part_sizes
from fruitlangs.engine.scene.sfm.placing import drop_lost
from fruitlangs.engine.scene.source import Source
from fruitlangs.engine.storage.files import file_hash
from fruitlangs.engine.storage.lock import hold_lock

VIEWS = 6


def write_photos(folder: Path, count: int = VIEWS) -> Path:
    folder.mkdir(parents=True)
    for view in range(count):
        render(view).save(folder / f"walk {view}.png")
    return folder


def posed(photos: Path, cache: Path) -> Source:
    """Photos alone with their cameras, estimated or from the cache."""
    return Source(path=photos).find_poses(cache, PhotosConfig())


@pytest.fixture(scope="session")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose images/ has the walk's photos, and whose cache/ the model made of them once."""
    folder = tmp_path_factory.mktemp("walk")
    posed(write_photos(folder / "images"), folder / "cache")
    return folder


def model_of(walk: Path) -> Path:
    (model,) = walk.glob("cache/photos-*/model")
    return model


def test_every_photo_is_posed_as_it_was_taken(walk: Path) -> None:
    scene = posed(walk / "images", walk / "cache").read(SceneConfig())
    found, true = np.stack([camera.center for camera in scene.cameras]), np.stack([*map(center, range(VIEWS))])
    off = np.linalg.norm(align(found, true).apply(found) - true, axis=1)
    assert [photo.name for photo in scene.images] == [f"walk {view}.png" for view in range(VIEWS)]
    assert off.max() < 0.05
    assert scene.cameras[0].width == pytest.approx(WIDTH, abs=4)
    assert scene.cameras[0].K[0, 0] == pytest.approx(FOCAL, rel=0.1)
    assert len(scene.points) > 100


def test_a_finished_model_is_used_again(walk: Path) -> None:
    before = (model_of(walk) / "images.bin").stat().st_mtime_ns
    found = posed(walk / "images", walk / "cache")
    assert found.reused
    assert (model_of(walk) / "images.bin").stat().st_mtime_ns == before
    assert not (model_of(walk).parent / "work").exists()


def test_two_runs_make_the_same_model_also_where_one_was_interrupted(walk: Path, tmp_path: Path) -> None:
    def stop(fraction: float, message: str) -> None:
        if message.startswith("placing"):
            raise Cancelled

    with pytest.raises(Cancelled):
        find_poses(walk / "images", tmp_path, progress=stop)
    assert not (tmp_path / "model").exists()
    again = find_poses(walk / "images", tmp_path)
    for file in ("cameras.bin", "images.bin", "points3D.bin"):
        assert (again.model / file).read_bytes() == (model_of(walk) / file).read_bytes()


def test_photos_and_settings_name_the_model_and_the_place_does_not(walk: Path, tmp_path: Path) -> None:
    shutil.copytree(walk / "images", tmp_path / "moved" / "images")
    shutil.copytree(walk / "cache", tmp_path / "far" / "away" / "cache")
    found = posed(tmp_path / "moved" / "images", tmp_path / "far" / "away" / "cache")
    assert found.reused
    assert found.hash() == posed(walk / "images", walk / "cache").hash()
    with pytest.raises(SceneError, match="no longer in"):
        Source(path=walk / "images").reuse_poses(walk / "cache", tmp_path, PhotosConfig(seed=1))


def test_another_result_gets_the_cameras_of_an_earlier_one(walk: Path, tmp_path: Path) -> None:
    kept = Source(path=walk / "images").reuse_poses(walk / "cache", tmp_path, PhotosConfig())
    assert kept.path.is_relative_to(tmp_path)
    first = posed(walk / "images", walk / "cache")
    assert dump_cameras(kept.read(SceneConfig())) == dump_cameras(first.read(SceneConfig()))


def test_a_mask_next_to_photos_without_a_model_is_used(walk: Path, tmp_path: Path) -> None:
    shutil.copytree(walk, tmp_path / "walk")
    (tmp_path / "walk" / "masks").mkdir()
    Image.fromarray(np.tile(np.uint8([0, 255]), (HEIGHT, WIDTH // 2))).save(tmp_path / "walk" / "masks" / "walk 2.png")
    found = posed(tmp_path / "walk" / "images", tmp_path / "walk" / "cache")
    masks = [photo.mask() for photo in found.read(SceneConfig()).images]
    assert masks[2] is not None
    assert masks[2].mean() < 0.6


def test_progress_names_every_step_and_never_goes_back(walk: Path, tmp_path: Path) -> None:
    told: list[tuple[float, str]] = []
    for photo in sorted((walk / "images").iterdir())[:3]:
        (tmp_path / "images").mkdir(exist_ok=True)
        shutil.copy(photo, tmp_path / "images")
    find_poses(tmp_path / "images", tmp_path, progress=lambda fraction, message: told.append((fraction, message)))
    assert np.all(np.diff([fraction for fraction, _ in told]) >= 0)
    steps = [message.partition(":")[0] for _, message in told]
    assert [s for s in dict.fromkeys(steps) if not s.startswith("reading")] == [
        "starting",
        "finding features",
        "matching photos",
        "placing photos",
        "matching placed photos",
        "refining cameras",
        "following points",
        "comparing surfaces",
    ]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_cancel_ends_the_child_while_it_is_busy(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started: list[subprocess.Popen[str]] = []
    popen = subprocess.Popen

    def start(command: list[str], **rest: object) -> subprocess.Popen[str]:
        started.append(popen([sys.executable, "-c", "while True: pass"], **rest))  # type: ignore[call-overload]
        return started[0]

    def stop(fraction: float, message: str) -> None:
        raise Cancelled

    monkeypatch.setattr(child_process.subprocess, "Popen", start)
    with pytest.raises(Cancelled):
        child_process.run_child("scene.mapping", [], tmp_path / "log.txt", stop)
    assert started[0].returncode is not None
    assert not alive(started[0].pid)


@pytest.mark.skipif(os.name != "posix", reason="kills a process as a cluster does")
def test_the_child_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    script = (
        "import os, sys, time; sys.path.insert(0, sys.argv[1]); import _checkout\n"
        "from fruitlangs.engine.child_process import end_with_parent\n"
        "end_with_parent(); print(os.getpid(), flush=True)\nwhile True: time.sleep(0.05)"
    )
    scripts = str(Path(__file__).resolve().parents[4] / "scripts")
    child = subprocess.Popen([sys.executable, "-c", script, scripts], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert child.stdin is not None
    assert child.stdout is not None
    child.stdout.readline()
    assert child.poll() is None
    child.stdin.close()  # what the death of the other side does
    assert child.wait(timeout=30) == 1
    child.stdout.close()


def test_a_child_that_crashes_is_an_error_and_not_a_wait(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(child_process, "_BOOT", "import os; os.abort()")
    write_photos(tmp_path / "images", 3)
    with pytest.raises(SceneError, match=f"No cameras were found .* code -{int(signal.SIGABRT)}.*log.txt"):
        find_poses(tmp_path / "images", tmp_path)


def run_boot(monkeypatch: pytest.MonkeyPatch, folder: Path, code: str) -> list[str]:
    """The progress messages of a child that runs `code`."""
    told: list[str] = []
    monkeypatch.setattr(child_process, "_BOOT", code)
    child_process.run_child("unused", [], folder / "log.txt", lambda fraction, message: told.append(message))
    return told


def test_output_in_another_encoding_does_not_stop_the_progress(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    write = r"import os; os.write(1, b'at\t0.1\tun\xe9\nd\xe9bogage\nat\tun\t\xe9\nat\t0.2\tdone\n')"
    assert run_boot(monkeypatch, tmp_path, write)[-1] == "done"


def test_a_child_that_ended_is_not_waited_for_although_its_output_stays_open(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    start = "import subprocess, sys; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(20)'])"
    begun = time.monotonic()
    run_boot(monkeypatch, tmp_path, start)
    assert time.monotonic() - begun < 10


def test_a_crash_names_its_log_and_quotes_the_last_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    crash = r"import os; os.write(2, b'first\nd\xe9faut de m\xe9moire\n'); os._exit(7)"
    said = rf"code 7\. The last line of {re.escape(str(tmp_path / 'log.txt'))} is: d.faut de m.moire"
    with pytest.raises(child_process.ChildError, match=said):
        run_boot(monkeypatch, tmp_path, crash)


def test_a_database_that_another_process_writes_to_is_left_alone(walk: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    work.mkdir()
    with hold_lock(work, work), pytest.raises(SceneError, match=f"in use by process {os.getpid()} on"):
        find_poses(walk / "images", tmp_path)
    assert not (work / "database.db").exists()


def test_the_run_may_be_in_a_thread_as_in_blender(walk: Path) -> None:
    found = []
    thread = threading.Thread(target=lambda: found.append(posed(walk / "images", walk / "cache")))
    thread.start()
    thread.join()
    assert found[0].reused


def few(folder: Path) -> str:
    write_photos(folder, 2)
    return r"has 2 photos. Take at least 3"


def unreadable(folder: Path) -> str:
    write_photos(folder, 3)
    (folder / "walk 1.png").write_bytes(b"not a picture")
    return r"walk 1\.png cannot be read as a picture"


def cut(folder: Path) -> str:
    write_photos(folder, 3)
    content = (folder / "walk 1.png").read_bytes()
    (folder / "walk 1.png").write_bytes(content[: len(content) // 2])
    return r"walk 1\.png cannot be decoded"


def unrelated(folder: Path) -> str:
    folder.mkdir()
    for index in range(3):
        noise = np.random.default_rng(index).integers(0, 255, (60, 80, 3), dtype=np.uint8)
        Image.fromarray(noise).resize((160, 120)).save(folder / f"{index}.png")
    return "no two photos show"


@pytest.mark.parametrize("make", [few, unreadable, cut, unrelated])
def test_photos_that_make_no_model_are_one_line_that_says_why(make, tmp_path: Path) -> None:
    said = make(tmp_path / "photos")
    with pytest.raises(SceneError, match=said) as caught:
        posed(tmp_path / "photos", tmp_path / "cache")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.glob("cache/photos-*/model"))


def test_photos_that_fit_nowhere_are_named(walk: Path, tmp_path: Path) -> None:
    shutil.copytree(walk / "images", tmp_path / "images")
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "images" / "a.png")
    (notice,) = find_poses(tmp_path / "images", tmp_path / "found").notices
    assert notice.startswith("1 of 7 photos could not be registered and were left out, first a.png")


def test_parts_whose_photos_were_all_placed_are_no_parts() -> None:
    def model(*photos: int) -> Any:
        return types.SimpleNamespace(num_reg_images=lambda: len(photos), reg_image_ids=lambda: list(photos))

    assert part_sizes(model(1, 2, 3, 4, 5), [model(3, 4, 5), model(5, 6, 7)]) == [5, 3]


def test_too_few_photos_in_the_model_are_an_error(walk: Path, tmp_path: Path) -> None:
    shutil.copytree(walk / "images", tmp_path / "images")
    for index in range(VIEWS + 1):
        noise = np.random.default_rng(index).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        Image.fromarray(noise).save(tmp_path / "images" / f"a{index}.png")
    with pytest.raises(SceneError, match="Only 6 of the 13 photos"):
        find_poses(tmp_path / "images", tmp_path / "found")


@pytest.mark.parametrize("place", ["images", "."])
def test_photos_alone_lie_in_the_folder_or_in_images(place: str, tmp_path: Path) -> None:
    (tmp_path / place).mkdir(exist_ok=True)
    Image.new("RGB", (32, 24)).save(tmp_path / place / "1.JPG")
    assert Source(path=tmp_path).photos_alone() == tmp_path / place
    (tmp_path / "transforms.json").touch()
    assert Source(path=tmp_path).photos_alone() is None


def test_settings_travel_to_the_child(tmp_path: Path) -> None:
    copy = Copy(name="ä 1.jpg", width=8, height=6, copy="000000.png", copy_width=4, copy_height=3, focal=0.9)
    config = dataclasses.replace(PhotosConfig(), seed=7)
    job = Job(folder=str(tmp_path), photos=[copy], config=config, threads=2)
    assert Job.read(job.write()) == job


def test_photos_alone_are_counted_and_asked_again_from_another_result(walk: Path, tmp_path: Path) -> None:
    shutil.copytree(walk / "images", tmp_path / "walk")
    shutil.copytree(walk / "cache", tmp_path / "first" / "cache")
    config = Config(train=TrainConfig(steps=20, max_gaussians=3000, holdout_every=0), count=CountConfig(threshold=0.9))
    first = count_scene(tmp_path / "walk", ["fruit"], tmp_path / "first", config=config)
    assert first.reused == ["photos"]
    second = count_scene(tmp_path / "first", ["leaf"], tmp_path / "second", config=config)
    third = count_scene(tmp_path / "second", ["apple"], tmp_path / "third", config=config)
    assert second.notices == third.notices == []
    assert len(list((third.out / "pictures").iterdir())) == 4


def test_a_run_reads_every_photo_for_its_hash_once_and_checks_the_model_once(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hashed, checked = Counter[str](), Counter[str]()

    def count_hash(path: Path) -> str:
        hashed[path.name] += 1
        return file_hash(path)

    def count_check(path: Path) -> int:
        checked[path.name] += 1
        return check_records(path)

    monkeypatch.setattr(source, "file_hash", count_hash)
    monkeypatch.setattr(colmap, "check_records", count_check)
    monkeypatch.setattr(layout, "check_records", count_check)
    shutil.copytree(walk / "cache", tmp_path / "cache")
    count_scene(
        walk / "images",
        ["fruit"],
        tmp_path,
        config=Config(train=TrainConfig(steps=20, max_gaussians=3000, holdout_every=0)),
    )
    assert set(hashed.values()) == set(checked.values()) == {1}
    assert checked.keys() >= {"cameras.bin", "images.bin", "points3D.bin"}
    hashed.clear()
    checked.clear()
    count_scene(tmp_path, ["apple"], tmp_path)
    assert set(hashed.values()) == set(checked.values()) == {1}


@pytest.mark.parametrize(
    ("photos", "placed", "attempts"), [(300, [299, 300], 1), (34, [33, 34], 1), (34, [32, 30], 2), (6, [0, 6], 2)]
)
def test_the_search_is_repeated_only_if_more_than_a_few_photos_were_not_placed(
    photos: int, placed: list[int], attempts: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    def models(job: Job, least_inliers: int, report: object) -> list[object]:
        made.append(least_inliers)
        number = placed[len(made) - 1]
        return [types.SimpleNamespace(num_reg_images=lambda: number, images={})] if number else []

    monkeypatch.setattr(placing, "_models", models)
    monkeypatch.setattr(placing, "match_pairs", lambda *_: None)
    copy = Copy(name="a", width=8, height=6, copy="0.png", copy_width=4, copy_height=3, focal=0.0)
    job = Job(folder="/x", photos=[copy] * photos, config=PhotosConfig(), threads=1)
    (best,) = placing.register_photos(job, [], lambda fraction, message: None)
    assert len(made) == attempts
    assert best.num_reg_images() == max(placed[:attempts])


def test_a_photo_that_is_placed_absurdly_far_away_is_taken_out_and_no_other() -> None:
    pycolmap = colmap_library()
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 10, 100
    model = pycolmap.synthesize_dataset(options)
    drop_lost(model)
    assert model.num_reg_images() == 10
    lost = model.frame(sorted(model.reg_frame_ids())[3])
    pose = lost.rig_from_world
    lost.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + [0.0, 0.0, 1e5])
    drop_lost(model)
    assert model.num_reg_images() == 9
    assert not lost.has_pose()
