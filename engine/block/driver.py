"""The driver: starts workers with submitit, on this computer or by Slurm, and watches until every tree is settled."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from ..child_process import usable_cores
from ..errors import ConfigError
from ..storage.files import write_text
from .ledger import LOG, Ledger, TreeState, run_name

Executor = Literal["local", "slurm"]
STATUS = "status.json"
CONTROLLERS = "controllers.txt"
"""File in the folder of logs."""
POLL_SECONDS = 1.0
PATIENCE = 10.0
"""Time between two looks at the states, in times that a look takes: 1.4 s for 10,000 trees."""
WORKER_BYTES = 3 << 30
"""Memory that a worker gets at least: 60 photos of 1600×1200 with cameras from photos alone take about that."""
LONGEST_MINUTES = 60 * 24 * 7
SettledTree = Callable[[str, TreeState], None]


@dataclass(frozen=True, kw_only=True)
class Workers:
    """jobs: workers at a time, None for as many as fit; partition, minutes, cores, gigabytes, gpus: of each, for
    Slurm."""

    executor: Executor = "local"
    jobs: int | None = None
    partition: str = ""
    minutes: int = LONGEST_MINUTES
    cores: int = 4
    gigabytes: float = 0.0
    gpus: int = 0

    def fitting(self, trees: int, cores: int, free: int) -> int:
        """The number of workers for this many trees on a computer with these cores and bytes: one for each core, if
        memory allows. Four trees took 89 s by two workers with a core each, and 120 s by one with two."""
        if self.jobs is not None:
            return max(min(self.jobs, trees), 1)
        if self.executor == "slurm":
            return max(min(trees, 16), 1)
        return max(min(trees, cores, free // WORKER_BYTES), 1)

    def threads(self, jobs: int, cores: int) -> int:
        """Threads of each of `jobs` workers: its part of the cores of this computer, or what Slurm reserves for it."""
        return self.cores if self.executor == "slurm" else max(cores // jobs, 1)


def drive(
    ledger: Ledger, workers: Workers, command: Sequence[str], *, free: int, settled: SettledTree = lambda *_: None
) -> dict[str, TreeState]:
    """Have every tree of the block counted; returns the states. settled: called for each tree that is done or failed.

    command: starts a worker, with the folder of the block and the name of the run appended; free: usable bytes.
    Workers that die are replaced as long as trees wait, and those of a dead node by Slurm as well.

    Raises:
        ConfigError: there is no such executor here.
    """
    import submitit

    logging.getLogger("submitit").setLevel(logging.ERROR)
    run, cores = run_name(), usable_cores()
    jobs = workers.fitting(sum(state.is_open(run) for state in ledger.states().values()), cores, free)
    executor = _executor(submitit, ledger.path / LOG, workers)
    line = [*command, str(ledger.path), run]
    threads = {name: str(workers.threads(jobs, cores)) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    function = submitit.helpers.CommandFunction(line, verbose=False, env={**os.environ, **threads})
    running: list[Any] = []
    told: set[str] = set()
    states: dict[str, TreeState] = {}
    try:
        while True:
            began = time.monotonic()
            before, states = states, ledger.states()
            pause = max(POLL_SECONDS, PATIENCE * (time.monotonic() - began))
            for own, state in states.items():
                if state.stage in ("done", "failed") and state.run == run and own not in told:
                    told.add(own)
                    settled(own, state)
            if states != before:
                _report(ledger, states)
            running = _alive(running, workers.executor)
            if not any(state.is_open(run) for state in states.values()):
                if not running:
                    return states
                time.sleep(POLL_SECONDS / 10)  # the last workers are about to end
                continue
            waiting = sum(state.is_open(run) and state.stage != "running" for state in states.values())
            for _ in range(min(jobs - len(running), waiting)):
                with _errors_into(ledger.path / LOG / CONTROLLERS):
                    running.append(executor.submit(function))
            time.sleep(pause)
    finally:
        for job in running:
            job.cancel(check=False)


@contextmanager
def _errors_into(path: Path) -> Iterator[None]:
    """Let processes that are started inside write their errors to a file: those of submitit, which start and watch
    local workers, print a traceback when a cancel ends them."""
    sys.stderr.flush()
    kept, log = os.dup(2), os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(log, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(log)


def _alive(jobs: Sequence[Any], executor: Executor) -> list[Any]:
    """The jobs that run or wait for a place. Slurm is asked by squeue: not every cluster has accounting, which submitit
    asks."""
    left = [job for job in jobs if not job.paths.result_pickle.exists()]
    if executor == "local" or not left:
        return [job for job in left if not job.done()]
    listed = subprocess.run(["squeue", "--noheader", "--format=%A"], capture_output=True, text=True, check=False)
    known = set(listed.stdout.split())
    return left if listed.returncode else [job for job in left if job.job_id in known]


def _executor(submitit: Any, log: Path, workers: Workers) -> Any:
    try:
        executor = submitit.AutoExecutor(folder=log, cluster=workers.executor)
    except RuntimeError as error:
        raise ConfigError(f"--executor {workers.executor} cannot be used here ({error})") from error
    executor.update_parameters(timeout_min=workers.minutes, cpus_per_task=workers.cores, name="fruitlangs")
    if workers.executor == "slurm":
        given = {"slurm_partition": workers.partition, "mem_gb": workers.gigabytes, "gpus_per_node": workers.gpus}
        executor.update_parameters(**{name: value for name, value in given.items() if value})
    return executor


def _report(ledger: Ledger, states: dict[str, TreeState]) -> None:
    """Write status.json, for programs that watch."""
    counts = Counter(state.stage for state in states.values())
    seconds = [state.seconds for state in states.values() if state.stage == "done" and state.seconds > 0.0]
    document = {
        **{stage: counts.get(stage, 0) for stage in ("waiting", "running", "done", "failed")},
        "mean_seconds": round(sum(seconds) / len(seconds), 1) if seconds else None,
        "trees": {own: asdict(state) for own, state in states.items()},
    }
    write_text(ledger.path / STATUS, json.dumps(document, indent=1))


def python_command(script: Path) -> list[str]:
    """The command that starts a worker of a script with this Python."""
    return [sys.executable, str(script), "--worker"]
