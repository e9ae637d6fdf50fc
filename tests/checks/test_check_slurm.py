"""A block on a real Slurm, where one is installed and asked for."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(
    "FRUITLANGS_SLURM" not in os.environ, reason="set FRUITLANGS_SLURM=1 where Slurm is installed, as root"
)
def test_killed_and_requeued_jobs_and_a_dead_node_lose_no_tree() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "checks" / "check_slurm.py")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "8 equal trees, each done once" in done.stdout
