"""In a real window: a whole day, import to export, by clicks and keys, and splats.

FRUITLANGS_WINDOW is the command that opens a Blender (4.2 or newer) with a window, for example
`blender` on a desktop or `xvfb-run -a blender` without one. Its Python needs the engine's packages.
"""

from __future__ import annotations

import json
import os
import shlex
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
WINDOW = os.environ.get("FRUITLANGS_WINDOW")


@pytest.mark.skipif(not WINDOW, reason="set FRUITLANGS_WINDOW to a command that opens a Blender window to run this")
def test_a_day_in_the_window_goes_as_it_should(balls, tmp_path):
    script = ROOT / "scripts" / "developer" / "picture_guide.py"
    blender = [*shlex.split(str(WINDOW)), "--enable-event-simulate", "-P", str(script), "--"]
    options = ["--steps", "150", "--threshold", "0.3", "--other", "grass", "--folder", str(tmp_path)]
    done = subprocess.run(
        [*blender, "--scene", str(balls), *options], capture_output=True, text=True, timeout=600, cwd=ROOT
    )
    told = [line for line in done.stdout.splitlines() if line.startswith(("ok", "NOT TRUE"))]
    assert done.returncode == 0, "\n".join([*told, done.stderr[-2000:]])
    assert len(told) > 10


@pytest.mark.skipif(not WINDOW, reason="set FRUITLANGS_WINDOW to a command that opens a Blender window to run this")
def test_splats_are_drawn_and_measured_in_a_window(tmp_path):
    out = tmp_path / "window.json"
    script = [str(ROOT / "scripts" / "developer" / "benchmark_window.py"), "--", "--gaussians", "500", "--repeats", "1"]
    done = subprocess.run(
        [*shlex.split(str(WINDOW)), "-P", *script, "--out", str(out)],
        capture_output=True,
        text=True,
        timeout=300,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    (row,) = json.loads(out.read_text())["rows"]
    assert row["same"]
    assert row["redraw_splats"] > 0
