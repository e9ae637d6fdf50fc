"""Scenes to measure: folders that are there, or presets of the orchard generator that are made when first asked for."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from ..engine.errors import SceneError

PRESETS = Path(__file__).resolve().parent / "scenes"
"""The generator's presets, one TOML file each."""
_MAKER = Path(__file__).resolve().parents[1] / "scripts" / "make_orchard.py"


def scene_folder(name: str, made: Path, *, report: Callable[[str], None] = lambda _: None) -> Path:
    """The folder of a scene: `name` itself, or for PRESET:SEED the scene that the generator makes in `made`.

    Making goes on where an earlier run stopped. Blender's module runs in a process of its own.

    Raises:
        SceneError: there is neither such a folder nor such a preset, or the scene could not be made.
    """
    if Path(name).is_dir():
        return Path(name)
    preset, _, seed = name.partition(":")
    if not (PRESETS / f"{preset}.toml").is_file() or not seed.isdecimal():
        raise SceneError(
            f"{name} is neither a scene's folder nor a preset with a seed such as apple-small:101; "
            "scripts/make_orchard.py --list shows the presets"
        )
    folder = made / f"{preset}-{seed}"
    command = [sys.executable, str(_MAKER), "--scene", preset, "--seed", seed, "--out", str(folder)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stderr is not None
    last = ""
    try:
        for line in process.stderr:
            last = line.strip() or last
            report(last)
    except BaseException:
        process.terminate()
        process.wait()
        raise
    if process.wait() != 0:
        raise SceneError(f"{name} could not be made: {last.removeprefix('error: ')}")
    return folder
