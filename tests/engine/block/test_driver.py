"""The driver starts workers, notices those that are of no use, and ends them with itself."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from fruitlangs.engine.block import driver
from fruitlangs.engine.block.driver import Workers, drive
from fruitlangs.engine.block.jobs import slurm_jobs
from fruitlangs.engine.block.ledger import Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry
from fruitlangs.engine.errors import ConfigError, OutputError

ROOT = Path(__file__).resolve().parents[3]
FREE = 1 << 40
PATHS = (
    f"import sys; sys.path[:0] = [{str(ROOT / 'scripts')!r}, {str(ROOT / 'tests/engine/block')!r}]; import _checkout"
)
WORKER = f"""
{PATHS}
import pathlib, time
from test_work import counted
from fruitlangs.engine.block.ledger import Ledger
from fruitlangs.engine.block.worker import work

def count(tree, ledger):
    counted(tree, ledger)
    time.sleep(0.5)  # the driver sees each tree

work(Ledger(pathlib.Path(sys.argv[1])), sys.argv[2], count=count)
"""
SLOW_WORKER = f"""
{PATHS}
import os, pathlib, time
from _terminal import run
from fruitlangs.engine.block.ledger import Ledger
from fruitlangs.engine.block.worker import work
from fruitlangs.engine.child_process import end_with_parent

def count(tree, ledger):
    (ledger.path / "pid").write_text(str(os.getpid()))
    time.sleep(60.0)

end_with_parent()
run(lambda: work(Ledger(pathlib.Path(sys.argv[1])), sys.argv[2], count=count))
"""
DRIVER = f"""
{PATHS}
import pathlib
from _terminal import run
from fruitlangs.engine.block.driver import Workers, drive
from fruitlangs.engine.block.ledger import Ledger
ledger, command = Ledger(pathlib.Path(sys.argv[1])), [sys.executable, "-c", sys.argv[2]]
run(lambda: drive(ledger, ledger.trees(), Workers(jobs=1), command, free=1 << 40))
"""


def entries(folder: Path, names: str) -> list[TreeEntry]:
    return [TreeEntry(id=name, source=folder / name, prompt=("apple",)) for name in names]


@pytest.fixture
def ledger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ledger:
    """A block of three trees, with a driver that looks often."""
    monkeypatch.setattr(driver, "POLL_SECONDS", 0.05)
    found = Ledger(tmp_path / "block")
    found.write_trees(entries(tmp_path, "abc"))
    return found


def ended(ledger: Ledger, code: str, **given: object) -> dict[str, str]:
    states = drive(ledger, ledger.trees(), Workers(jobs=1), [sys.executable, "-c", code], free=FREE, **given)  # type: ignore[arg-type]
    return {own: state.stage for own, state in states.items()}


def test_workers_count_all_trees(ledger: Ledger) -> None:
    assert ended(ledger, WORKER) == dict.fromkeys("abc", "done")


def test_each_tree_is_reported_when_it_starts_and_when_it_is_done(ledger: Ledger) -> None:
    reported: list[tuple[str, str]] = []

    def changed(own: str, state: TreeState) -> None:
        reported.append((own, state.stage))
        (ledger.path / f"seen-{own}").touch()

    wait = "[time.sleep(0.05) for _ in range(200) if not (ledger.path / f'seen-{tree.id}').exists()]"
    ended(ledger, WORKER.replace("time.sleep(0.5)", wait), changed=changed)
    assert reported == [(own, stage) for own in "abc" for stage in ("running", "done")]


def test_workers_that_die_before_they_count_end_the_command_with_the_last_line_of_their_log(ledger: Ledger) -> None:
    with pytest.raises(OutputError, match=r"3 workers in a row .*_log\.err is: .*No module named 'no_such_module'"):
        ended(ledger, "import no_such_module")
    assert len(list((ledger.path / "log").glob("*_log.err"))) == driver.MOST_IDLE


def test_workers_that_die_with_a_tree_are_replaced(ledger: Ledger, tmp_path: Path) -> None:
    ledger.write_trees(entries(tmp_path, "a"))
    dying = WORKER.replace("count=count", "count=lambda *_: __import__('os')._exit(1)")
    assert ended(ledger, dying) == {"a": "failed"}
    assert "3 workers died with it" in ledger.states()["a"].reason


def test_a_command_whose_trees_another_one_took_away_is_an_error(ledger: Ledger, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"removed or changed 2 of 3 trees of .*, such as 'b'"):
        ended(ledger, WORKER, changed=lambda *_: ledger.write_trees(entries(tmp_path, "a")))


def test_trees_that_another_command_adds_are_counted_as_well(ledger: Ledger, tmp_path: Path) -> None:
    found = ended(ledger, WORKER, changed=lambda *_: ledger.write_trees(entries(tmp_path, "abcd")))
    assert found == dict.fromkeys("abcd", "done")


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGKILL])
def test_workers_end_with_their_driver(ledger: Ledger, sent: signal.Signals) -> None:
    process = subprocess.Popen([sys.executable, "-c", DRIVER, str(ledger.path), SLOW_WORKER])
    pid = ledger.path / "pid"
    until(lambda: pid.is_file() and pid.read_text() != "")
    worker = int(pid.read_text())
    process.send_signal(sent)
    assert process.wait(30) == (130 if sent == signal.SIGTERM else -sent)
    until(lambda: not lives(worker))
    until(lambda: ledger.states()["a"].stage == "waiting")  # the system frees a dead process's lock a moment later
    if sent == signal.SIGTERM:  # the worker could note it, and did not die
        assert ledger.state(ledger.trees()[0]).stage == "waiting"


def until(true: object, seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not true():  # type: ignore[operator]
        assert time.monotonic() < end
        time.sleep(0.05)


def lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of programs that stand in for Slurm's: jobs get numbers and wait for ever, until they are cancelled."""
    programs = tmp_path / "bin"
    programs.mkdir()
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr(driver, "POLL_SECONDS", 0.05)
    program(programs / "srun", "")
    program(programs / "sbatch", f'echo x >> {tmp_path}/jobs\necho "Submitted batch job $(wc -l < {tmp_path}/jobs)"')
    program(programs / "squeue", f"echo asked >> {tmp_path}/asked\nseq $(wc -l < {tmp_path}/jobs)")
    program(programs / "scancel", f'echo "$@" >> {tmp_path}/cancelled')
    return programs


def program(path: Path, lines: str) -> None:
    path.write_text(f"#!/bin/sh\n{lines}\n")
    path.chmod(0o755)


def test_a_job_that_slurm_refuses_is_an_error_with_its_reason(ledger: Ledger, slurm: Path) -> None:
    program(slurm / "sbatch", 'echo "sbatch: error: invalid partition specified: none" >&2; exit 1')
    with pytest.raises(ConfigError, match=r"invalid partition specified: none.*Check --partition"):
        drive(ledger, ledger.trees(), Workers(executor="slurm"), ["x"], free=FREE)


def test_jobs_that_wait_for_a_place_are_cancelled_when_all_trees_are_done(
    ledger: Ledger, slurm: Path, tmp_path: Path
) -> None:
    given = Workers(executor="slurm", jobs=2)
    thread = threading.Thread(target=lambda: drive(ledger, ledger.trees(), given, ["x"], free=FREE), daemon=True)
    thread.start()
    until(lambda: (tmp_path / "jobs").is_file() and len((tmp_path / "jobs").read_text().split()) == 2)
    for tree in ledger.trees():
        folder = ledger.result(tree).path
        folder.mkdir(parents=True)
        (folder / "fruits.json").write_text("{}")
        ledger.write(tree, TreeState(stage="done", fingerprint=tree.fingerprint, run="other"))
    thread.join(20.0)
    assert not thread.is_alive()
    assert (tmp_path / "cancelled").read_text().split() == ["1", "2"]


def test_jobs_of_slurm_that_end_without_a_log_are_an_error(ledger: Ledger, slurm: Path) -> None:
    program(slurm / "squeue", "")
    with pytest.raises(OutputError, match=r"_log\.err is empty\. Check that memory is free, and that each node has"):
        drive(ledger, ledger.trees(), Workers(executor="slurm", jobs=1), ["x"], free=FREE)


def test_a_job_of_slurm_has_the_cards_of_its_node_and_stores_no_environment(
    slurm: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOME_TOKEN", "secret-123")
    show = "import os; print(os.environ['CUDA_VISIBLE_DEVICES'], os.environ['NUMBA_NUM_THREADS'])"
    jobs = slurm_jobs([sys.executable, "-c", show], {"NUMBA_NUM_THREADS": "4"}, tmp_path / "log", {"timeout_min": 1})
    jobs.start()
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")  # what Slurm sets for the job
    assert jobs.function().split() == ["3", "4"]
    (stored,) = (tmp_path / "log").glob("*.pkl")
    assert b"secret-123" not in stored.read_bytes()
