"""Scenes to measure: existing folders, or presets of the orchard generator, which are generated on demand."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..engine.errors import ConfigError, FormatError, FruitLangsError, SceneError
from ..engine.progress import Progress, part

TRUTH, ORCHARD = "truth.json", "orchard.json"
PRESETS = Path(__file__).resolve().parent / "scenes"
"""The generator's presets, one TOML file each."""
_MAKER = Path(__file__).resolve().parents[1] / "scripts" / "make_orchard.py"


@dataclass(frozen=True, kw_only=True)
class Origin:
    """The origin of a generated scene; empty and None for other scenes."""

    species: str = ""
    seed: int | None = None


def read_origin(folder: Path) -> Origin:
    """The scene's orchard.json; empty without one.

    Raises:
        FormatError: it is damaged, or the scene is incomplete.
    """
    path = folder / ORCHARD
    if not path.is_file():
        return Origin()
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        complete = document.get("complete") is True
        origin = Origin(species=str(document["config"]["species"]), seed=int(document["config"]["seed"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(f"{path} is damaged ({error}). Make the scene again") from error
    if not complete:
        raise FormatError(f"{folder} is incomplete. Run make_orchard.py again with the same settings to resume")
    return origin


def scene_folder(name: str, made: Path, *, report: Callable[[str], None] = lambda _: None) -> Path:
    """The folder of a scene: `name` itself, or for PRESET:SEED the scene that is generated in `made`.

    An interrupted generation is continued. Blender's module runs in a separate process.

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


def measure_each(
    names: Sequence[str],
    out: Path,
    work: Callable[[Path, Progress], None],
    *,
    report: Callable[[str], None],
    progress: Progress,
) -> list[str]:
    """Call `work` with the folder of each scene (see `scene_folder`); the failure of a scene does not stop the others.

    Presets are generated in `out`/scenes; `out`/NAME is the folder of each scene, so names must be unique. Returns one
    line per failed scene.
    """
    failed, taken = [], {"scenes"}
    for number, name in enumerate(names):
        try:
            folder = scene_folder(name, out / "scenes", report=report).resolve()
            if folder.name in taken:
                raise ConfigError(f"There is another scene called {folder.name}. Rename its folder")
            taken.add(folder.name)
            work(folder, part(progress, number / len(names), (number + 1) / len(names)))
        except FruitLangsError as error:
            failed.append(f"{name}: {error}")
            report(failed[-1])
    return failed
