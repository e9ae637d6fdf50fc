"""The command line as a person meets it: exit codes, one clear line, nothing lost."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "examples" / "orchard_tree"
SMALL = ["--scene.downscale", "4", "--train.max-gaussians", "8000", "--no-blend"]


def command(*arguments: str | Path) -> list[str]:
    return [sys.executable, str(ROOT / "scripts" / "count_fruit.py"), *map(str, arguments)]


def count(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


def copy_of_sample(folder: Path) -> Path:
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("instances", "truth.json"))
    return folder


def truncate(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])


def test_help_names_every_stage() -> None:
    done = count("--help")
    assert done.returncode == 0
    assert all(f"--{stage}." in done.stdout for stage in ("scene", "train", "count"))


def test_wrong_usage_exits_with_2() -> None:
    assert count("--no-such-flag").returncode == 2


def make_missing(folder: Path) -> str:
    return str(folder)


def make_empty_model(folder: Path) -> str:
    copy_of_sample(folder)
    for name, record_count in (("cameras", 0), ("images", 0), ("points3D", 0)):
        (folder / "sparse" / "0" / f"{name}.bin").write_bytes(record_count.to_bytes(8, "little"))
    return "sparse"


def make_without_images(folder: Path) -> str:
    shutil.rmtree(copy_of_sample(folder) / "images")
    return "images"


def make_with_one_image_gone(folder: Path) -> str:
    first = sorted((copy_of_sample(folder) / "images").iterdir())[0]
    first.unlink()
    return first.name


def make_with_short_points(folder: Path) -> str:
    truncate(copy_of_sample(folder) / "sparse" / "0" / "points3D.bin", 0.9)
    return "points3D.bin"


def make_with_short_cameras(folder: Path) -> str:
    truncate(copy_of_sample(folder) / "sparse" / "0" / "cameras.bin", 0.9)
    return "cameras.bin"


def make_a_file(folder: Path) -> str:
    folder.write_bytes(b"not a folder")
    return folder.name


@pytest.mark.parametrize(
    "make",
    [
        make_missing,
        make_empty_model,
        make_without_images,
        make_with_one_image_gone,
        make_with_short_points,
        make_with_short_cameras,
        make_a_file,
    ],
)
def test_a_bad_scene_is_one_clear_line_and_exit_1(make, tmp_path: Path) -> None:
    culprit = make(tmp_path / "scene")
    done = count(tmp_path / "scene", "--prompt", "apple", "--out", tmp_path / "out", *SMALL)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: ")
    assert culprit in done.stderr
    assert not (tmp_path / "out" / "fruits.json").exists()


def test_an_unknown_word_is_one_clear_line_that_names_the_nearest(tmp_path: Path) -> None:
    done = count(SAMPLE, "--prompt", "appel", "--out", tmp_path)
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "apple" in done.stderr


def test_an_output_folder_that_cannot_be_written_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    done = count(SAMPLE, "--prompt", "apple", "--out", tmp_path / "file" / "out")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert "file" in done.stderr


def wait_for_checkpoint(out: Path, process: subprocess.Popen[str]) -> None:
    """Until training has written a checkpoint."""
    for _ in range(1200):
        if list(out.glob("cache/train-*/checkpoint*")):
            return
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.1)
    raise AssertionError("no checkpoint appeared")


@pytest.mark.parametrize(("sent", "expected"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -9)])
def test_a_stopped_training_leaves_earlier_results_and_a_checkpoint(sent: int, expected: int, tmp_path: Path) -> None:
    (tmp_path / "fruits.json").write_text("earlier")
    arguments = command(SAMPLE, "--prompt", "apple", "--out", tmp_path, *SMALL, "--train.steps", "20000")
    process = subprocess.Popen(arguments, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    wait_for_checkpoint(tmp_path, process)
    os.kill(process.pid, sent)
    process.communicate(timeout=60)
    assert process.returncode == expected
    assert (tmp_path / "fruits.json").read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()].count("gaussians.ply") == 0
