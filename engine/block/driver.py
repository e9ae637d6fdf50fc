"""The driver: starts workers, on this computer or by Slurm, and watches until every tree is settled."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from ..child_process import usable_cores
from ..errors import ConfigError
from ..storage.files import write_text
from .jobs import Jobs, LocalJobs, explain_no_progress, slurm_jobs
from .ledger import LOG, Ledger, TreeState, run_name
from .manifest import TreeEntry

Executor = Literal["local", "slurm"]
STATUS = "status.json"
POLL_SECONDS = 1.0
PATIENCE = 10.0
"""Time between two looks at the states, in times that a look takes: 1.4 s for 10,000 trees."""
WORKER_BYTES = 7 << 29
"""Memory that a worker gets at least: 80 photos of 960×720 take about that."""
MOST_IDLE = 3
"""Workers in a row that may end without any effect although trees wait: those that lack a package do."""
LONGEST_MINUTES = 60 * 24 * 7
ChangedTree = Callable[[str, TreeState], None]


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

    def count_workers(self, trees: int, cores: int, free: int) -> int:
        """Count the workers for this many trees on a computer with these cores and bytes: one for each core, if memory
        allows. Four trees took 89 s by two workers with a core each, and 120 s by one with two."""
        if self.jobs is not None:
            return max(min(self.jobs, trees), 1)
        if self.executor == "slurm":
            return max(min(trees, 16), 1)
        return max(min(trees, cores, free // WORKER_BYTES), 1)

    def threads(self, jobs: int, cores: int) -> int:
        """Threads of each of `jobs` workers: its part of the cores of this computer, or what Slurm reserves for it."""
        return self.cores if self.executor == "slurm" else max(cores // jobs, 1)


def drive(
    ledger: Ledger,
    trees: Sequence[TreeEntry],
    workers: Workers,
    command: Sequence[str],
    *,
    free: int,
    changed: ChangedTree = lambda *_: None,
) -> dict[str, TreeState]:
    """Have every tree of the block counted; returns the states. changed: called for each tree that starts, is done or
    failed.

    trees: those that the block must have, to which another command may add some; command: starts a worker, with the
    folder of the block, the name of the run and the executor appended; free: usable bytes. Only trees that are open are
    counted: `Ledger.reopen` opens those that failed before, or whose inputs have changed. Workers that die are replaced
    as long as trees wait, and those of a dead node by Slurm as well.

    Raises:
        ConfigError: there is no such executor here, Slurm refuses a job, or another command took trees away.
        OutputError: workers end without any effect; tells what the last one wrote.
    """
    run, cores = run_name(), usable_cores()
    most = workers.count_workers(sum(state.is_open for state in ledger.states().values()), cores, free)
    jobs = _jobs(workers, [*command, str(ledger.path), run, workers.executor], ledger.path / LOG, run, most, cores)
    running: list[Any] = []
    reported: dict[str, TreeState] = {}
    states: dict[str, TreeState] = {}
    idle = 0  # workers in a row that ended although trees wait, and left every state as it was
    try:
        while True:
            began = time.monotonic()
            before, started, running = states, running, jobs.alive(running)
            states = ledger.states()  # after the jobs, so that what an ended one did is in it
            pause = max(POLL_SECONDS, PATIENCE * (time.monotonic() - began))
            _require_trees(ledger, trees, states)
            for own, state in states.items():
                if state.stage != "waiting" and state.run == run and reported.get(own) != state:
                    reported[own] = state
                    changed(own, state)
            if states != before:
                _report(ledger, states)
            if not any(state.is_open for state in states.values()):
                time.sleep(POLL_SECONDS if running else 0.0)  # workers that find no more trees end by themselves
                running = jobs.alive(running)
                return states
            waiting = sum(state.stage == "waiting" for state in states.values())
            ended = [job for job in started if job not in running]
            idle = 0 if states != before else idle + len(ended) * (waiting > 0)
            if idle < MOST_IDLE:
                for _ in range(min(most - len(running), waiting)):
                    running.append(jobs.start())
            elif not running:
                raise explain_no_progress(jobs.log(ended[-1]), idle)
            time.sleep(pause)
    finally:
        jobs.cancel(running)


def _jobs(workers: Workers, command: Sequence[str], folder: Path, run: str, most: int, cores: int) -> Jobs:
    threads = {name: str(workers.threads(most, cores)) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    if workers.executor == "local":
        return LocalJobs(command=command, environment=threads, folder=folder, name=run, minutes=workers.minutes)
    given = {"slurm_partition": workers.partition, "mem_gb": workers.gigabytes, "gpus_per_node": workers.gpus}
    settings = {"timeout_min": workers.minutes, "cpus_per_task": workers.cores}
    return slurm_jobs(command, threads, folder, settings | {name: value for name, value in given.items() if value})


def _require_trees(ledger: Ledger, trees: Sequence[TreeEntry], states: Mapping[str, TreeState]) -> None:
    """
    Raises:
        ConfigError: another command has written a manifest without some of the trees, or with other settings of them.
    """
    lost = [each.id for each in trees if each.id not in states or states[each.id].fingerprint != each.fingerprint]
    if lost:
        raise ConfigError(
            f"Another command has removed or changed {len(lost)} of {len(trees)} trees of {ledger.path}, such as "
            f"'{lost[0]}'. Count other trees into another folder, or run this command again when that one has ended"
        )


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
