from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fruitlangs.engine.errors import OutputError
from fruitlangs.engine.storage.files import files_hash, replacing, require_writable, write_tensors, write_text


def test_a_failed_write_leaves_the_old_file_and_no_temporary_one(tmp_path: Path) -> None:
    target = tmp_path / "fruits.json"
    write_text(target, "old")

    def fail() -> None:
        with replacing(target) as temporary:
            temporary.write_text("half of the ne")
            raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        fail()
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_tensors_may_be_read_by_whoever_may_read_the_other_files(tmp_path: Path) -> None:
    write_text(tmp_path / "fruits.json", "{}")
    write_tensors(tmp_path / "selection.safetensors", {"a": torch.zeros(3)}, {})
    modes = {path.stat().st_mode for path in tmp_path.iterdir()}
    assert len(modes) == 1


def test_an_output_folder_below_a_file_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(OutputError, match="taken"):
        require_writable(tmp_path / "taken" / "out")


def test_a_writable_folder_is_made_and_left_empty(tmp_path: Path) -> None:
    require_writable(tmp_path / "new")
    assert list((tmp_path / "new").iterdir()) == []


def test_the_hash_of_files_depends_on_names_and_bytes_but_not_on_the_folder(tmp_path: Path) -> None:
    def hashed(folder: str, name: str, text: str) -> str:
        path = tmp_path / folder / name
        write_text(path, text)
        return files_hash([path], tmp_path / folder)

    assert hashed("a", "x", "1") == hashed("b", "x", "1")
    assert hashed("a", "x", "1") != hashed("a", "y", "1")
    assert hashed("a", "x", "1") != hashed("a", "x", "2")
