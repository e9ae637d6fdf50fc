"""One science, many doors: the panel's operators and the command line write the same fruits.json."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import bpy

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "count_fruit.py"


def told(folder: Path) -> dict:
    """fruits.json without what may differ: when it was, how long it took, and Blender's own file."""
    document = json.loads((folder / "fruits.json").read_text(encoding="utf-8"))
    for name in ("date", "seconds"):
        del document["provenance"][name]
    return document


def test_operators_and_command_line_write_the_same_result(extension, balls, tmp_path):
    settings = bpy.context.scene.fruitlangs
    settings.source, settings.out = str(balls), str(tmp_path / "window")
    settings.prompt, settings.negative = "red apple", "leaf"
    settings.config.train.steps, settings.config.train.max_gaussians = 150, 3000
    settings.config.count.threshold = 0.3
    bpy.ops.fruitlangs.import_scene()
    bpy.ops.fruitlangs.reconstruct()
    bpy.ops.fruitlangs.count()
    given = ["--prompt", "red apple", "--negative", "leaf", "--out", str(tmp_path / "terminal"), "--no-blend"]
    given += ["--train.steps", "150", "--train.max-gaussians", "3000", "--count.threshold", "0.3"]
    subprocess.run([sys.executable, str(SCRIPT), str(balls), *given], check=True)
    window, terminal = told(tmp_path / "window"), told(tmp_path / "terminal")
    assert window["count"] > 0
    assert window == terminal
