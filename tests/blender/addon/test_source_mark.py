"""A source is known by one of its files, wherever it lies."""

from __future__ import annotations

import shutil

import pytest

from fruitlangs.operators.settings.source_mark import has_mark, source_mark


@pytest.mark.parametrize(
    "file", ["images/IMG_1.JPG", "IMG 1.png", "images/left/IMG_1.jpg", "transforms.json", "images.bin", "walk.MOV"]
)
def test_a_folder_is_known_again_where_it_was_moved_and_distinguished_from_another_like_it(tmp_path, file):
    here, other = tmp_path / "here", tmp_path / "other"
    for folder in (here, other):
        (folder / file).parent.mkdir(parents=True)
        (folder / file).write_bytes(f"in {folder.name}".ljust(20).encode())
    mark = source_mark(here)
    assert has_mark(shutil.move(here, tmp_path / "there"), mark)
    assert not has_mark(other, mark)


@pytest.mark.parametrize("suffix", [".ply", ".mp4"])
def test_a_file_is_known_by_its_own_bytes(tmp_path, suffix):
    for name in (f"tree{suffix}", f"other{suffix}"):
        (tmp_path / name).write_bytes(name.encode())
    mark = source_mark(tmp_path / f"tree{suffix}")
    assert has_mark((tmp_path / f"tree{suffix}").rename(tmp_path / f"moved{suffix}"), mark)
    assert not has_mark(tmp_path / f"other{suffix}", mark)


def test_photos_that_are_added_later_make_no_other_source(tmp_path):
    (tmp_path / "IMG_5.jpg").write_bytes(b"five")
    mark = source_mark(tmp_path)
    (tmp_path / "IMG_1.jpg").write_bytes(b"one")
    assert has_mark(tmp_path, mark)


def test_what_is_gone_or_empty_has_no_mark_and_is_never_known_by_it(tmp_path):
    assert source_mark(tmp_path) == source_mark(tmp_path / "gone") == ""
    assert not has_mark(tmp_path, "")
    assert not has_mark(tmp_path / "gone", "IMG_1.jpg 00")
