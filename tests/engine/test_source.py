"""A result names its source and does not tell where on this computer it is."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from fruitlangs.engine.pipeline import Result
from fruitlangs.engine.result_folder import ResultFolder


def test_no_file_that_is_passed_on_holds_the_path_of_the_photos(counted_balls: Result, balls: Path) -> None:
    document = json.loads((counted_balls.out / "fruits.json").read_text())
    assert document["provenance"]["source"] == balls.name
    shared = [path for path in counted_balls.out.iterdir() if path.is_file()]
    assert len(shared) > 8
    assert [path.name for path in shared if str(balls.parent).encode() in path.read_bytes()] == []


def test_the_cache_holds_the_path_so_that_a_later_prompt_finds_the_photos(counted_balls: Result, balls: Path) -> None:
    document = json.loads((counted_balls.out / "fruits.json").read_text())
    assert ResultFolder(counted_balls.out).source(document) == balls.resolve()


def test_without_a_cache_the_source_is_searched_next_to_the_result(counted_balls: Result, tmp_path: Path) -> None:
    copy = shutil.copytree(counted_balls.out, tmp_path / "copy", ignore=shutil.ignore_patterns("cache"))
    document = json.loads((copy / "fruits.json").read_text())
    assert ResultFolder(copy).source(document) == tmp_path / document["provenance"]["source"]


def test_a_result_of_an_earlier_version_holds_its_path_itself(tmp_path: Path) -> None:
    assert ResultFolder(tmp_path).source({"provenance": {"source": "/photos/tree"}}) == Path("/photos/tree")
