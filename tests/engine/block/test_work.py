"""Every tree of a block is counted once, whatever dies on the way, and a failed tree is never a count."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fruitlangs.engine.block.driver import Workers
from fruitlangs.engine.block.ledger import MOST_CRASHES, Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry
from fruitlangs.engine.block.trees import read_counts
from fruitlangs.engine.block.worker import work
from fruitlangs.engine.errors import Cancelled, FormatError, OutputError, SceneError

ROOT = Path(__file__).resolve().parents[3]


def entries(count: int, folder: Path) -> list[TreeEntry]:
    return [TreeEntry(id=f"t{k}", source=folder / f"photos{k}", prompt=("apple",)) for k in range(count)]


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    found = Ledger(tmp_path / "block")
    found.write_trees(entries(4, tmp_path))
    return found


def counted(tree: TreeEntry, ledger: Ledger, count: int = 3) -> None:
    """A stand-in for a count: a result with so many fruit."""
    folder = ledger.result(tree).path
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "fruits.json").write_text(json.dumps({"count": count}))


def stages(ledger: Ledger) -> list[str]:
    return [state.stage for state in ledger.states().values()]


def test_a_worker_counts_all_trees_and_another_run_counts_none(ledger: Ledger) -> None:
    assert work(ledger, "one", count=counted) == 4
    assert stages(ledger) == ["done"] * 4
    assert work(ledger, "two", count=lambda *_: pytest.fail("counted again")) == 0


def test_a_tree_that_was_added_or_changed_is_counted_and_no_other(ledger: Ledger, tmp_path: Path) -> None:
    work(ledger, "one", count=counted)
    trees = entries(5, tmp_path)
    trees[1] = TreeEntry(id="t1", source=trees[1].source, prompt=("pear",))
    ledger.write_trees(trees)
    again: list[str] = []

    def noted(tree: TreeEntry, own: Ledger) -> None:
        again.append(tree.id)
        counted(tree, own)

    work(ledger, "two", count=noted)
    assert again == ["t1", "t4"]


def test_a_tree_whose_result_was_deleted_is_counted_again(ledger: Ledger) -> None:
    work(ledger, "one", count=counted)
    (ledger.path / "trees" / "t2" / "fruits.json").unlink()
    assert stages(ledger) == ["done", "done", "waiting", "done"]
    assert work(ledger, "two", count=counted) == 1


def test_a_failed_tree_has_its_reason_and_is_tried_again_after_it_was_reopened_only(ledger: Ledger) -> None:
    def fail(tree: TreeEntry, own: Ledger) -> None:
        if tree.id == "t1":
            raise SceneError("no photos\nat all")
        counted(tree, own)

    assert work(ledger, "one", count=fail) == 3
    assert ledger.states()["t1"] == TreeState(
        stage="failed", fingerprint=ledger.trees()[1].fingerprint, run="one", reason="no photos at all"
    )
    for run in ("one", "two"):  # of two drivers at work, neither tries again what failed with the other
        assert work(ledger, run, count=lambda *_: pytest.fail("tried again")) == 0
    ledger.reopen()
    assert stages(ledger) == ["done", "waiting", "done", "done"]
    assert work(ledger, "two", count=counted) == 1


def test_a_cancelled_tree_waits(ledger: Ledger) -> None:
    def cancel(*_: object) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        work(ledger, "one", count=cancel)
    assert stages(ledger) == ["waiting"] * 4


def test_a_tree_that_another_worker_holds_is_left_to_it(ledger: Ledger) -> None:
    held = ledger.trees()[2]
    with ledger.claim(held) as mine:
        assert mine
        ledger.write(held, TreeState(stage="running", fingerprint=held.fingerprint, run="other"))
        assert work(ledger, "one", count=counted) == 3
        assert ledger.states()["t2"].stage == "running"
    assert ledger.states()["t2"].stage == "waiting"  # its worker is gone


class Death(BaseException):
    """What stands in for the end of a worker without a word."""


def die(*_: object) -> None:
    raise Death


@pytest.mark.parametrize("error", [OSError("disk full"), TypeError("no len"), MemoryError()])
def test_any_error_of_a_count_fails_its_tree_at_once_and_keeps_the_traceback(ledger: Ledger, error: Exception) -> None:
    def fail(tree: TreeEntry, own: Ledger) -> None:
        if tree.id == "t1":
            raise error
        counted(tree, own)

    assert work(ledger, "one", count=fail) == 3
    state, log = ledger.states()["t1"], ledger.path / "log" / "t1_error.txt"
    assert state.stage == "failed"
    assert state.reason.startswith(f"{type(error).__name__}: {error or 'without a message'}")
    assert state.reason.endswith(f"See {log}")
    assert "in fail" in log.read_text()


def test_a_tree_that_kills_its_workers_is_given_up(ledger: Ledger) -> None:
    """A worker that dies leaves its tree running without a holder."""
    tree = ledger.trees()[0]
    for crashes in range(MOST_CRASHES):
        assert ledger.state(tree).crashes == max(crashes - 1, 0)
        with pytest.raises(Death):  # nothing is written any more
            work(ledger, "one", count=die)
    assert work(ledger, "one", count=counted) == 3
    assert "workers died with it" in ledger.states()["t0"].reason
    ledger.reopen()
    assert work(ledger, "two", count=counted) == 1


def test_the_folder_of_no_block_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is not the folder of a block"):
        Ledger(tmp_path).trees()


@pytest.mark.parametrize(
    "changed",
    [{"colour": "red"}, {"id": "../t"}, {"id": "nul"}, {"id": 3}, {"prompt": [3]}, {"latitude": "n"}, {"settings": 3}],
)
def test_a_damaged_folder_or_one_of_another_version_is_an_error_that_says_what_to_do(
    ledger: Ledger, changed: dict[str, object]
) -> None:
    listed = json.loads((ledger.path / "manifest.json").read_text())
    (ledger.path / "manifest.json").write_text(json.dumps([{**each, **changed} for each in listed]))
    with pytest.raises(FormatError, match=r"is damaged or of another version .*Count into another folder"):
        ledger.trees()


@pytest.mark.parametrize("text", ['{"stage": "do', "[]", '{"stage": 3}', '{"crashes": "x"}', '{"seconds": NaN}'])
def test_a_damaged_state_is_a_tree_that_waits(ledger: Ledger, text: str) -> None:
    work(ledger, "one", count=counted)
    (ledger.path / "states" / "t3.json").write_text(text)
    assert stages(ledger) == ["done", "done", "done", "waiting"]


WORKER = """
import sys, time, pathlib
sys.path[:0] = [sys.argv[1] + "/scripts", sys.argv[1] + "/tests/engine/block"]
import _checkout
from test_work import counted
from fruitlangs.engine.block.ledger import Ledger
from fruitlangs.engine.block.worker import work

def count(tree, ledger):
    time.sleep(0.01)
    counted(tree, ledger, int(tree.id[1:]) % 7)

print("ready", flush=True)
work(Ledger(pathlib.Path(sys.argv[2])), sys.argv[3], count=count)
"""


def test_kills_at_random_lose_and_double_nothing(tmp_path: Path) -> None:
    ledger, chance = Ledger(tmp_path / "block"), random.Random(0)
    ledger.write_trees(entries(150, tmp_path))
    kills, began = 0, time.monotonic()
    while any(stage != "done" for stage in stages(ledger)):
        assert time.monotonic() < began + 120
        pair = [
            subprocess.Popen(
                [sys.executable, "-c", WORKER, str(ROOT), str(ledger.path), "run"], stdout=subprocess.PIPE, text=True
            )
            for _ in range(2)
        ]
        for worker in pair:
            assert worker.stdout is not None
            assert worker.stdout.readline() == "ready\n"
        if kills < 4:
            time.sleep(chance.uniform(0.05, 0.2))
            for worker in pair:
                os.kill(worker.pid, signal.SIGKILL)
            kills += 2
        for worker in pair:
            worker.wait()
    assert kills == 4
    found = [
        json.loads((ledger.path / "trees" / tree.id / "fruits.json").read_text())["count"] for tree in ledger.trees()
    ]
    assert sum(found) == sum(k % 7 for k in range(150))
    assert all(state.crashes == 0 for state in ledger.states().values())


def test_a_failed_tree_has_no_count_in_the_tables(ledger: Ledger) -> None:
    def fail(*_: object) -> None:
        raise SceneError("no photos")

    work(ledger, "one", count=fail)
    assert all(tree.visible is None and tree.state.reason == "no photos" for tree in read_counts(ledger))


@pytest.mark.parametrize(
    ("given", "trees", "cores", "free", "expected"),
    [
        (Workers(), 100, 8, 64 << 30, (8, 1)),
        (Workers(), 3, 8, 64 << 30, (3, 2)),
        (Workers(), 100, 8, 7 << 30, (2, 4)),
        (Workers(jobs=4), 100, 2, 64 << 30, (4, 1)),
        (Workers(executor="slurm", cores=6), 100, 2, 1 << 30, (16, 6)),
    ],
    ids=["a worker a core", "few trees", "little memory", "as asked", "Slurm"],
)
def test_workers_share_the_cores_and_have_memory_enough(
    given: Workers, trees: int, cores: int, free: int, expected: tuple[int, int]
) -> None:
    jobs = given.count_workers(trees, cores, free)
    assert (jobs, given.threads(jobs, cores)) == expected
