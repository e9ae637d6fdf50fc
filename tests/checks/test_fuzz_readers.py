"""The check of all readers with damaged files: what it reports when a reader is at fault."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import fuzz_readers
import numpy as np
import pytest

from fruitlangs.engine.errors import FormatError


def outcome(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: Callable[[Path, Path], object]) -> str:
    valid = tmp_path / "valid"
    valid.mkdir()
    (valid / "file").write_bytes(bytes(range(48, 58)) * 20)
    monkeypatch.setattr(fuzz_readers, "KINDS", {"kind": fuzz_readers.Kind(("file",), reader)})
    told = fuzz_readers.attempt(valid, 0, 0)
    assert (valid / "file").read_bytes() == bytes(range(48, 58)) * 20
    return told


def refuse(_: Path, path: Path) -> object:
    raise FormatError(f"{path} is damaged. Write it again")


def forget(_: Path, path: Path) -> object:
    return {}[path]


def allocate(_: Path, path: Path) -> object:
    return np.ones(fuzz_readers.ROOM)


def test_a_file_is_read_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert outcome(tmp_path, monkeypatch, lambda _, path: path.read_bytes()) == "read"


def test_a_sentence_is_no_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert outcome(tmp_path, monkeypatch, refuse) == "refused"


def test_another_error_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert outcome(tmp_path, monkeypatch, forget).startswith("failed: KeyError")


def test_memory_beyond_the_size_of_the_file_is_a_fault(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "failed: " in outcome(tmp_path, monkeypatch, allocate)


def test_every_damage_changes_some_bytes_and_the_same_seed_gives_the_same() -> None:
    data = b'{"id": 12, "x": 3.5, "list": [1, 2, 3]}' * 10
    made = [fuzz_readers.damage(data, np.random.default_rng(seed)) for seed in range(40)]
    again = [fuzz_readers.damage(data, np.random.default_rng(seed)) for seed in range(40)]
    assert made == again
    assert sum(each != data for each in made) > 35
    assert len(set(made)) > 30
