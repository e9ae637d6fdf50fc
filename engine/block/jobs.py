"""Starts and ends the workers of a block: processes of this computer, or jobs of Slurm by submitit."""

from __future__ import annotations

import itertools
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from ..errors import ConfigError, OutputError

GRACE = 10.0
"""Seconds that a worker of this computer has to note that its tree waits, before it is ended."""
_OF_SLURM = ("srun: ", "slurmstepd: ")
"""How lines of a log begin that Slurm wrote, not the worker."""


class Jobs(Protocol):
    """Where workers run. A job is one worker; only its `Jobs` knows what it is."""

    def start(self) -> Any:
        """Start a worker, or let it wait for a place.

        Raises:
            ConfigError: it is refused.
        """
        ...

    def alive(self, jobs: Sequence[Any]) -> list[Any]:
        """Those that run or wait for a place."""
        ...

    def cancel(self, jobs: Sequence[Any]) -> None:
        """End them."""
        ...

    def log(self, job: Any) -> Path:
        """The file to which it writes its errors."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class LocalJob:
    """A worker of this computer. end: when its time is over, by `time.monotonic`."""

    process: subprocess.Popen[bytes]
    log: Path
    end: float


@dataclass(frozen=True, kw_only=True)
class LocalJobs:
    """Workers that are processes of this computer. A worker's standard input ends when this process does, for whatever
    reason, and the worker then ends as well (`end_with_parent`).

    command: of a worker; environment: what it has in addition to that of this process; folder: of the logs; name: with
    which they begin; minutes: longest time of a worker.
    """

    command: Sequence[str]
    environment: Mapping[str, str]
    folder: Path
    name: str
    minutes: float
    numbers: Iterator[int] = field(default_factory=itertools.count)

    def start(self) -> LocalJob:
        path = self.folder / f"{self.name}_{next(self.numbers)}_log.err"
        try:
            with path.open("wb") as log:
                process = subprocess.Popen(
                    self.command,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    env={**os.environ, **self.environment},
                    start_new_session=True,  # Ctrl-C in a terminal reaches this process only, which ends its workers
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
        except OSError as error:
            raise ConfigError(f"No worker can be started ({error}). Check the folder {self.folder}") from error
        return LocalJob(process=process, log=path, end=time.monotonic() + 60.0 * self.minutes)

    def alive(self, jobs: Sequence[LocalJob]) -> list[LocalJob]:
        self.cancel([job for job in jobs if time.monotonic() > job.end])
        return [job for job in jobs if job.process.poll() is None]

    def cancel(self, jobs: Sequence[LocalJob]) -> None:
        running = [job.process for job in jobs if job.process.poll() is None]
        if sys.platform != "win32":  # which has no such signal for another process
            for process in running:
                process.send_signal(signal.SIGINT)
            last = time.monotonic() + GRACE
            for process in running:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(max(last - time.monotonic(), 0.0))
        for process in running:
            process.kill()
            process.wait()

    def log(self, job: LocalJob) -> Path:
        return job.log


@dataclass(frozen=True, kw_only=True)
class SlurmJobs:
    """Workers that are jobs of Slurm. executor, function: submitit's."""

    executor: Any
    function: Any

    def start(self) -> Any:
        from submitit.core.utils import FailedJobError, FailedSubmissionError

        try:
            return self.executor.submit(self.function)
        except (FailedJobError, FailedSubmissionError, OSError) as error:
            raise ConfigError(
                f"Slurm refuses a job ({' '.join(str(error).split())}). "
                "Check --partition, --minutes, --cores, --gigabytes and --gpus"
            ) from error

    def alive(self, jobs: Sequence[Any]) -> list[Any]:
        """Slurm is asked by squeue: not every cluster has accounting, which submitit asks."""
        left = [job for job in jobs if not job.paths.result_pickle.exists()]
        if not left:
            return []
        listed = subprocess.run(["squeue", "--noheader", "--format=%A"], capture_output=True, text=True, check=False)
        known = set(listed.stdout.split())
        return left if listed.returncode else [job for job in left if job.job_id in known]

    def cancel(self, jobs: Sequence[Any]) -> None:
        for job in jobs:
            job.cancel(check=False)

    def log(self, job: Any) -> Path:
        return Path(job.paths.stderr)


def slurm_jobs(
    command: Sequence[str], environment: Mapping[str, str], folder: Path, settings: Mapping[str, Any]
) -> SlurmJobs:
    """Workers by Slurm. environment: what they have in addition to what Slurm gives the job; settings: submitit's
    parameters.

    Raises:
        ConfigError: there is no Slurm here.
    """
    import submitit

    logging.getLogger("submitit").setLevel(logging.ERROR)
    # submitit stores the command in a file. The environment of this process does not concern it: Slurm hands it on,
    # and adds the cards and cores of the job.
    given = ["env", *(f"{name}={value}" for name, value in environment.items())]
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster="slurm")
    except RuntimeError as error:
        raise ConfigError(f"--executor slurm cannot be used here ({error})") from error
    executor.update_parameters(name="fruitlangs", **settings)
    return SlurmJobs(executor=executor, function=submitit.helpers.CommandFunction([*given, *command], verbose=False))


def explain_no_progress(log: Path, ended: int) -> OutputError:
    """Say what to report when so many workers in a row ended without any effect. log: of the last one."""
    try:
        written = log.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        written = []
    lines = [line.strip() for line in written if line.strip() and not line.startswith(_OF_SLURM)]
    what = f"{ended} workers in a row ended before they counted a tree"
    if not lines:
        return OutputError(f"{what}, and {log} is empty. Check that memory is free, and that each node has this folder")
    return OutputError(f"{what}. The last line of {log} is: {lines[-1]}. Correct that, and run the command again")
