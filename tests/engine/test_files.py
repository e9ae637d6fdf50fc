from __future__ import annotations

from pathlib import Path

import pytest
import torch

from fruitlangs.engine.errors import OutputError
from fruitlangs.engine.storage import keys
from fruitlangs.engine.storage.files import files_hash, replace_file, require_writable, write_tensors, write_text


def test_a_failed_write_leaves_the_old_file_and_no_temporary_one(tmp_path: Path) -> None:
    target = tmp_path / "fruits.json"
    write_text(target, "old")

    def fail() -> None:
        with replace_file(target) as temporary:
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


def test_a_key_of_code_that_is_not_there_is_refused() -> None:
    with pytest.raises(ValueError, match="engine/nowhere has no code"):
        keys.stage_key(("nowhere",), "input")


@pytest.mark.parametrize("changed", ["package/inner/code.py", "package/weights.safetensors", "module.py"])
def test_a_key_changes_with_the_code_and_the_weights_that_it_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    monkeypatch.setattr(keys, "_ENGINE", tmp_path)

    def key() -> str:
        keys._code_hash.cache_clear()
        return keys.stage_key(("package", "module"), "input")

    for name in ("package/inner/code.py", "package/weights.safetensors", "module.py", "other.py"):
        write_text(tmp_path / name, "before")
    before = key()
    write_text(tmp_path / "other.py", "after")
    assert key() == before
    write_text(tmp_path / changed, "after")
    assert key() != before
    keys._code_hash.cache_clear()


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("pipeline.py", False),
        ("counting/accounts/interval.json", False),
        ("language/weights.safetensors", False),
        ("splatting/kernel.wgsl", False),
        ("package/new.py", False),
        ("block/tables.py", True),
        ("evaluation/metrics.py", True),
        ("photo_check/cost.py", True),
        ("report/page.html", True),
    ],
)
def test_the_key_of_the_program_changes_with_all_code_that_a_count_depends_on(
    name: str, same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keys, "_ENGINE", tmp_path)

    def key() -> str:
        keys.program_key.cache_clear()
        return keys.program_key()

    write_text(tmp_path / "count.py", "before")
    try:
        before = key()
        write_text(tmp_path / name, "after")
        assert (key() == before) == same
    finally:
        keys.program_key.cache_clear()
