"""One command counts the trees of a block, goes on where it stopped, and says what failed."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
QUICK = "train.steps=150 | train.max-gaussians=3000 | count.threshold=0.3"


def count(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, ROOT / "scripts" / "count_orchard.py", *arguments]
    return subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def block(balls: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a manifest of two trees, of which it has the photos of the second, and a missing one."""
    folder = tmp_path_factory.mktemp("block")
    shutil.copytree(balls, folder / "two")
    lines = [f"1,{balls},apple,A", "2,two,apple,B", "3,missing,apple,B"]
    (folder / "orchard.csv").write_text("\n".join(["id,source,prompt,row", *lines, ""]))
    return folder


def test_a_block_is_counted_resumed_and_summed_up(block: Path) -> None:
    out = block / "out"
    first = count(block / "orchard.csv", "--out", out, "--settings", QUICK, "--jobs", 2)
    assert first.returncode == 1
    assert first.stderr.splitlines()[-1].startswith("error: 1 of 3 trees failed and are not in the sums")
    assert "1: started\n" in first.stdout
    assert "1: 5 fruit in " in first.stdout
    assert "missing does not exist" in first.stdout
    rows = {row["tree"]: row for row in csv.DictReader((out / "orchard.csv").open())}
    assert [rows[own]["count"] for own in "123"] == ["5", "5", ""]
    document = json.loads((out / "orchard.json").read_text())
    assert document["block"]["count"] == 10
    status = json.loads((out / "status.json").read_text())
    assert (status["done"], status["failed"], status["waiting"]) == (2, 1, 0)
    assert (out / "trees" / "1" / "report.html").is_file()
    assert "orchard.html" in first.stdout

    before = (out / "trees" / "1" / "fruits.json").stat().st_mtime_ns
    text = (block / "orchard.csv").read_text().replace("3,missing,apple,B\n", "")
    (block / "orchard.csv").write_text(text)
    second = count(block / "orchard.csv", "--out", out, "--settings", QUICK)
    assert second.returncode == 0, second.stderr
    assert "2 of 2 trees are done" in second.stdout
    assert "counted again" not in second.stdout
    assert (out / "trees" / "1" / "fruits.json").stat().st_mtime_ns == before

    shutil.copy(block / "two" / "images" / "000.png", block / "two" / "images" / "099.png")
    changed = "files of its source were added, removed or changed"
    plan = count(block / "orchard.csv", "--out", out, "--settings", QUICK, "--dry-run").stdout.splitlines()
    assert plan[0] == "1: done"
    assert plan[1].startswith("2: 16 photos, about ")
    assert plan[1].endswith(f" (again: {changed})")
    third = count(block / "orchard.csv", "--out", out, "--settings", QUICK)
    assert third.returncode == 0, third.stderr
    assert f"1 of 2 trees are done\n1 tree is counted again (2): {changed}\n2: started\n2: 5 fruit in " in third.stdout
    assert "1: started" not in third.stdout
    assert (out / "trees" / "1" / "fruits.json").stat().st_mtime_ns == before

    shutil.rmtree(block / "two")
    plan = count(block / "orchard.csv", "--out", out, "--settings", QUICK, "--dry-run").stdout.splitlines()
    missing = f"its source {block / 'two'} is missing or empty, so its earlier count is kept unchecked"
    assert plan == ["1: done", f"2: done, but {missing}"]
    fourth = count(block / "orchard.csv", "--out", out, "--settings", QUICK)
    assert fourth.returncode == 0, fourth.stderr
    assert f"  note on 2: {missing}\n" in fourth.stdout
    assert json.loads((out / "orchard.json").read_text())["block"]["count"] == 10
    assert {row["tree"]: row["reason"] for row in csv.DictReader((out / "orchard.csv").open())} == {
        "1": "",
        "2": missing,
    }


def dry_run(folder: Path, *lines: str) -> subprocess.CompletedProcess[str]:
    (folder / "orchard.csv").write_text("\n".join(["id,source,prompt", *lines, ""]))
    return count(folder / "orchard.csv", "--out", folder / "out", "--dry-run")


def test_a_dry_run_says_what_it_would_do_and_writes_nothing(balls: Path, tmp_path: Path) -> None:
    (tmp_path / "row.mp4").touch()
    done = dry_run(tmp_path, f"1,{balls},apple", "2,row.mp4,apple")
    assert done.returncode == 0, done.stderr
    assert re.search(r"^1: 16 photos, about \d+ min and", done.stdout)
    assert "\n2: it has no photo from which its time can be estimated\n" in done.stdout
    assert re.search(r"\nin all about [1-9]\d* min with all cores", done.stdout)
    assert not (tmp_path / "out").exists()


def test_the_time_of_photos_of_several_sizes_does_not_depend_on_their_order(tmp_path: Path) -> None:
    for tree, sizes in (("first", (400, 2400, 2400)), ("last", (2400, 2400, 400))):
        (tmp_path / tree).mkdir()
        for number, side in enumerate(sizes):
            Image.new("RGB", (side, side)).save(tmp_path / tree / f"{number}.jpg")
    done = dry_run(tmp_path, "1,first,apple", "2,last,apple")
    first, last = done.stdout.splitlines()[:2]
    assert first.removeprefix("1: ") == last.removeprefix("2: ")
    assert first.startswith("1: 3 photos, about")


def test_a_dry_run_fails_if_a_tree_has_a_wrong_word_or_no_source(balls: Path, tmp_path: Path) -> None:
    done = dry_run(tmp_path, f"1,{balls},aple", "2,missing,apple", f"3,{balls},apple")
    assert done.returncode == 1
    assert done.stderr == "error: 2 of 3 trees cannot be counted. The reasons are above\n"
    word, source, right = done.stdout.splitlines()[:3]
    assert "does not know the word 'aple'" in word
    assert "missing does not exist" in source
    assert right.startswith("3: 16 photos")


def test_the_sums_of_several_prompts_are_said_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    from count_orchard import block_text

    apple, pear = ({"trees": k, "count": 9 * k, "likely": 10.0 * k, "low": 9.0, "high": 12.0 * k} for k in (1, 2))
    document = {"trees": 4, "done": 3, "rows": {}, "elsewhere": 0, "notes": {}, "block": pear}
    document["prompts"] = {
        "apple": {**apple, "rows": {"A": apple}},
        "pear": {**pear, "rows": {}, "all_trees": {"trees": 9, "likely": 60.0, "low": 30.0, "high": 90.0}},
    }
    assert block_text(document).splitlines() == [
        "block: visible fruit counted on 3 of 4 trees: 9 apple, 18 pear",
        "  apple: 9 on 1 tree, most likely 10 (9–12)",
        "    row A: 9 on 1 tree, most likely 10 (9–12)",
        "  pear: 18 on 2 trees, most likely 20 (9–24)",
        "    all 9 trees: 60 (30–90)",
    ]


def test_a_sum_without_an_interval_and_notes_on_counts_are_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    from count_orchard import block_text

    unknown = {"trees": 7, "count": 70, "without_interval": 2, "likely": None, "low": None, "high": None}
    document = {"trees": 8, "done": 7, "rows": {"A": unknown}, "elsewhere": 0, "block": unknown}
    document["notes"] = {f"t{number}": f"note {number}" for number in range(7)}
    without = "without an interval, because 2 of 7 have none"
    assert block_text(document).splitlines() == [
        f"block: 70 visible fruit counted on 7 of 8 trees, {without}",
        f"  row A: 70 on 7 trees, {without}",
        *(f"  note on t{number}: note {number}" for number in range(5)),
        "  notes on 2 more are in the tables",
    ]


def test_trees_that_are_counted_again_are_listed_by_reason(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "scripts"))
    from count_orchard import say_before

    from fruitlangs.engine.block.ledger import TreeState

    states = {f"t{number}": TreeState(reason="newer") for number in range(7)}
    say_before({**states, "a": TreeState(reason="photos"), "b": TreeState(stage="done"), "c": TreeState()})
    assert capsys.readouterr().out.splitlines() == [
        "1 of 10 trees are done",
        "7 trees are counted again (t0, t1, t2, t3, t4 and 2 more): newer",
        "1 tree is counted again (a): photos",
    ]


def test_more_trees_than_the_block_has_are_an_error_before_anything_is_counted(block: Path, tmp_path: Path) -> None:
    done = count(block / "orchard.csv", "--out", tmp_path / "out", "--all-trees", 1)
    assert done.returncode == 1
    assert "which is more than the 1 of the block (--all-trees)" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [(["gone.csv"], "gone.csv cannot be read"), ([], "nothing says what to count. Fill the column prompt")],
)
def test_what_is_wrong_is_one_line(arguments: list[str], text: str, tmp_path: Path) -> None:
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "a.jpg").write_bytes(b"")
    done = count(*(arguments or [tmp_path]), "--out", tmp_path / "out")
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1
    assert text in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_block_in_which_every_tree_failed_has_tables_and_an_error(tmp_path: Path) -> None:
    (tmp_path / "orchard.csv").write_text("id,source,prompt\n1,missing,apple\n")
    done = count(tmp_path / "orchard.csv", "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("error: 1 of 1 trees failed and are not in the sums")
    assert "block: no tree was counted\n" in done.stdout
    assert (tmp_path / "out" / "orchard.html").is_file()


@pytest.mark.parametrize("page", ["--help", "--help-all"])
def test_help_has_no_heading_for_settings_that_the_script_does_not_have(page: str) -> None:
    done = count(page)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].split() == ["-h,", "--help", "Show", "this", "page."]
