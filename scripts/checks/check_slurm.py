"""Count a block on a real Slurm of this computer, with jobs that are killed and requeued and a node that dies.

    python scripts/checks/check_slurm.py

Starts a cluster of one node in a temporary folder; needs root, and Debian's packages slurm-wlm and munge. It counts the
sample eight times with a short training, and exits with 1 if a tree is lost, counted wrong or counted twice at a time.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401

from _terminal import run, say
from fruitlangs.engine.errors import ConfigError, CountingError

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ("slurmctld", "slurmd", "sbatch", "squeue", "scancel", "scontrol", "munged")
TREES = 8
SETTINGS = "train.steps=60 | train.max-gaussians=3000 | scene.downscale=4"
PATIENCE = 600.0
CONFIG = """
ClusterName=one
SlurmctldHost={host}
SlurmUser=root
AuthType=auth/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/ctld.pid
SlurmdPidFile={folder}/d.pid
SlurmctldLogFile={folder}/ctld.log
SlurmdLogFile={folder}/d.log
ProctrackType=proctrack/pgid
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SlurmdTimeout=30
JobRequeue=1
NodeName={host} CPUs={cores} RealMemory=6000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def find_missing_programs() -> list[str]:
    """Find the programs of Slurm that this computer lacks; "root" if this process may not start them."""
    found = [name for name in PROGRAMS if shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin") is None]
    return found or ([] if os.geteuid() == 0 else ["root"])


class Node:
    """The only node of the cluster."""

    def __init__(self) -> None:
        self.daemon = self._start_daemon()

    def fail(self, folder: str) -> None:
        """Die with the workers of a block, without a word, and come back. folder: of the block."""
        self.end()
        for pid in find_processes("cmdline", "--worker", folder):
            with suppress(OSError):  # it has ended
                os.kill(pid, signal.SIGKILL)
        time.sleep(3.0)
        self.daemon = self._start_daemon()

    def end(self) -> None:
        """End the daemon, and those of its jobs, which outlive it."""
        _end(self.daemon)
        for pid in find_processes("environ", f"SLURM_CONF={os.environ['SLURM_CONF']}"):
            with suppress(OSError):  # it has ended
                if Path(f"/proc/{pid}/comm").read_text().strip() == "slurmstepd":
                    os.kill(pid, signal.SIGKILL)

    @staticmethod
    def _start_daemon() -> subprocess.Popen[bytes]:
        return subprocess.Popen(["slurmd", "-D"], stderr=subprocess.DEVNULL)


def find_processes(file: str, *parts: str) -> list[int]:
    """Find the processes whose command line ("cmdline") or environment ("environ") has all of these parts."""
    found = []
    for each in Path("/proc").glob(f"[0-9]*/{file}"):
        with suppress(OSError):  # it has ended
            if set(parts) <= set(each.read_bytes().decode(errors="replace").split("\0")):
                found.append(int(each.parent.name))
    return found


def _end(daemon: subprocess.Popen[bytes]) -> None:
    daemon.kill()
    daemon.wait()


@contextmanager
def run_munge() -> Iterator[None]:
    """Run a daemon of munge as long as the block runs, if none runs already."""
    if not subprocess.run(["munge", "-n"], capture_output=True, check=False).returncode:
        yield
        return
    Path("/run/munge").mkdir(exist_ok=True)
    shutil.chown("/run/munge", "munge", "munge")
    daemon = subprocess.Popen(["munged", "--foreground"], user="munge", group="munge", extra_groups=[])
    try:
        while subprocess.run(["munge", "-n"], capture_output=True, check=False).returncode:
            if daemon.poll() is not None:
                raise ConfigError("munged does not run. Start it and run this check again")
            time.sleep(0.2)
        yield
    finally:
        daemon.terminate()
        daemon.wait()


@contextmanager
def run_cluster(folder: Path) -> Iterator[Node]:
    """Run a Slurm of one node as long as the block runs; the commands find it by SLURM_CONF."""
    for name in ("state", "spool"):
        (folder / name).mkdir()
    config = folder / "slurm.conf"
    host = socket.gethostname().split(".")[0]
    config.write_text(CONFIG.format(host=host, folder=folder, cores=os.cpu_count()))
    os.environ["SLURM_CONF"] = str(config)
    os.environ["PATH"] += ":/usr/sbin"
    with run_munge():
        controller = subprocess.Popen(["slurmctld", "-D"], stderr=subprocess.DEVNULL)
        time.sleep(2.0)
        node = Node()
        try:
            yield node
        finally:
            subprocess.run(["scancel", "--user", "root"], check=False)
            node.end()
            _end(controller)


def list_jobs() -> list[str]:
    """List the numbers of the jobs that run."""
    listed = subprocess.run(["squeue", "-h", "-t", "R", "-o", "%A"], capture_output=True, text=True, check=True)
    return listed.stdout.split()


def read_states(out: Path) -> dict[str, str]:
    """Read {tree: state} as the driver last wrote it."""
    try:
        trees = json.loads((out / "status.json").read_text())["trees"]
    except (OSError, ValueError):
        return {}
    return {own: state["stage"] for own, state in trees.items()}


def wait_for(out: Path, done: int) -> None:
    """Return when so many trees are done and a job runs.

    Raises:
        CountingError: that takes too long.
    """
    end = time.monotonic() + PATIENCE
    while sum(stage == "done" for stage in read_states(out).values()) < done or not list_jobs():
        if time.monotonic() > end:
            raise CountingError(f"After {PATIENCE:.0f} s less than {done} trees are done: {read_states(out)}")
        time.sleep(1.0)


def main() -> None:
    """Count the block and disturb it.

    Raises:
        ConfigError: Slurm is not installed.
        CountingError: a tree is lost or wrong.
    """
    if lacking := find_missing_programs():
        raise ConfigError(f"This computer lacks {', '.join(lacking)}. As root: apt-get install slurm-wlm munge")
    with tempfile.TemporaryDirectory(prefix="slurm-") as name, run_cluster(Path(name)) as node:
        folder, out = Path(name), Path(name) / "out"
        lines = [f"{k},{ROOT / 'examples' / 'orchard_tree'},apple" for k in range(TREES)]
        (folder / "orchard.csv").write_text("\n".join(["id,source,prompt", *lines, ""]))
        command = [sys.executable, str(ROOT / "scripts" / "count_orchard.py"), str(folder / "orchard.csv"), "--out"]
        options = [
            str(out),
            "--executor",
            "slurm",
            "--jobs",
            "2",
            "--cores",
            "1",
            "--gigabytes",
            "2",
            "--settings",
            SETTINGS,
        ]
        driver = subprocess.Popen([*command, *options])
        wait_for(out, 1)
        say("a job is killed")
        subprocess.run(["scancel", "--signal=KILL", list_jobs()[0]], check=True)
        wait_for(out, 3)
        say("a job is requeued")
        subprocess.run(["scontrol", "requeue", list_jobs()[0]], check=True)
        wait_for(out, 5)
        say("the node dies and comes back")
        node.fail(str(out))
        code = driver.wait(PATIENCE)
        found = read_states(out)
        counts = {json.loads(each.read_text())["count"] for each in out.glob("trees/*/fruits.json")}
    if code or list(found.values()) != ["done"] * TREES or len(counts) != 1:
        raise CountingError(f"The driver ended with {code}, trees are {found}, counts {counts}")
    say(f"{TREES} equal trees, each done once, {counts.pop()} fruit each")


if __name__ == "__main__":
    run(main)
