"""The committed baseline: results of the ladder with date and commit."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from ...engine.storage.files import write_text
from .ladder import StageResult
from .pages import rows_csv, table_parts

_ROOT = Path(__file__).resolve().parents[2]


def publish(rows: Sequence[StageResult], folder: Path, *, command: str) -> None:
    """Write results.csv and RESULTS.md into `folder`. command: how to repeat the measurement."""
    commit = _commit()  # before anything is written, which would change it
    write_text(folder / "results.csv", rows_csv(rows))
    day = datetime.now(UTC).date().isoformat()
    parts = [
        "# Baseline",
        f"Measured on {day} at commit {commit} by `{command}`. All columns are in [results.csv](results.csv); what "
        "the rungs and columns mean is in [docs/benchmark.md](../docs/benchmark.md).",
        *table_parts(rows),
    ]
    write_text(folder / "RESULTS.md", "\n\n".join(parts) + "\n")


def _commit() -> str:
    """The short name of the checkout's commit, marked if files differ from it; `unknown` outside a repository."""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=10"],
            cwd=_ROOT,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return described.stdout.strip()
