"""The check of photos on the command line: what it prints, where it writes, and its exit codes."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from fruitlangs.engine.photo_check.sheet import sheet_folder

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "examples" / "orchard_tree"


def check(*arguments: str | Path, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "scripts" / "check_photos.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, errors="replace", check=False, cwd=cwd)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Six neighbouring photos of the sample at one height, the third dark."""
    folder = tmp_path / "tree"
    folder.mkdir()
    for number, file in enumerate(sorted((SAMPLE / "images").iterdir())[:12:2]):
        picture: Image.Image = Image.open(file)
        if number == 2:
            picture = picture.point(lambda value: int(0.5 * value))
        picture.save(folder / file.name)
    return folder


def test_findings_are_printed_with_what_to_do_and_are_not_an_error(photos: Path, tmp_path: Path) -> None:
    done = check(photos, "--out", tmp_path / "check")
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert "6 photos, 0 problems, 2 warnings" in text
    assert "What to do: Lock the exposure" in text
    assert "finding cameras" in text
    assert "005.jpg" in text


def test_the_contact_sheet_is_in_a_folder_next_to_the_photos(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    before = sorted(photos.iterdir())
    done = check(photos, cwd=tmp_path / "here")
    assert done.returncode == 0, done.stderr
    assert Image.open(tmp_path / "tree-check" / "contact_sheet.jpg").width > 1000
    assert sorted(photos.iterdir()) == before
    assert list((tmp_path / "here").iterdir()) == []


def test_the_contact_sheet_of_the_sample_is_not_among_the_files_of_the_checkout(tmp_path: Path) -> None:
    check_photos = importlib.import_module("check_photos")
    inside = sheet_folder(SAMPLE)
    assert check_photos.keep_outside_checkout(inside) == ROOT / "results" / "orchard_tree-check"
    assert check_photos.keep_outside_checkout(tmp_path / "tree-check") == tmp_path / "tree-check"


def test_a_folder_inside_that_of_the_photos_is_refused(photos: Path) -> None:
    done = check(photos, "--out", photos / "check")
    assert done.returncode == 1
    assert "inside the folder of the photos" in done.stderr
    assert not (photos / "check").exists()


def test_a_folder_that_does_not_exist_is_an_error_in_one_line(tmp_path: Path) -> None:
    done = check(tmp_path / "nothing", "--out", tmp_path / "check")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "check").exists()


def test_wrong_usage_exits_with_2(photos: Path) -> None:
    assert check().returncode == 2
    assert check(photos, "--no-such-flag").returncode == 2
