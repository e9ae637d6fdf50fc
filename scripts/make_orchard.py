"""Build a synthetic fruit tree in Blender, render a walk around it, and write the scene with its truth.

    python scripts/make_orchard.py --out results/orchard
    blender -b --factory-startup --python-exit-code 1 -P scripts/make_orchard.py -- --out results/orchard

Writes images/, a COLMAP model in sparse/0/, instances/ (16-bit masks of fruit ids), truth.json and orchard.json.
"""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

from _terminal import arguments_of, import_tyro, run
from orchard.check import check
from orchard.config import FIRST_TRAINING_SEED, OrchardConfig, training_config
from orchard.errors import OrchardError

if TYPE_CHECKING:
    import tyro
else:
    tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Command:
    """Build a synthetic fruit tree in Blender and render a walk around it."""

    out: Path
    """Folder to write; with --scenes the folder of many scenes."""

    classes: bool = False
    """Also write classes/ and classes.json: what every pixel shows, for training an image encoder."""

    preview: int = 0
    """Render only so many views of the walk; 0: all."""

    scenes: str = ""
    """FIRST:LAST, the seeds of a training set, from 1000 up: small scenes, three in five close-ups and two in five
    walks; their other settings are drawn by seed."""

    config: Annotated[OrchardConfig, tyro.conf.OmitArgPrefixes] = field(default_factory=OrchardConfig)


def report(message: str) -> None:
    """Tell how far it is: one line a step, on stderr."""
    print(message, file=sys.stderr, flush=True)


def seeds_of(scenes: str) -> range:
    """The seeds that FIRST:LAST names, both included."""
    first, _, last = scenes.partition(":")
    if not (first.isdecimal() and last.isdecimal()) or not FIRST_TRAINING_SEED <= int(first) <= int(last):
        low = FIRST_TRAINING_SEED
        raise OrchardError(f"--scenes {scenes}: give FIRST:LAST with {low} <= FIRST <= LAST, such as {low}:{low + 59}")
    return range(int(first), int(last) + 1)


def make(command: Command) -> None:
    """Make the scene, or every scene of the training set."""
    configs = list(map(training_config, seeds_of(command.scenes))) if command.scenes else [command.config]
    for config in configs:
        check(config)
    if command.preview < 0:
        raise OrchardError(f"preview is {command.preview}: give the number of views, or 0 for all")
    for package in ("bpy", "pycolmap"):
        if importlib.util.find_spec(package) is None:
            install = f'"{sys.executable}" -m pip install {package}'
            raise OrchardError(f"the package {package} is missing in this Python; run: {install}")
    from orchard.produce import produce, write_scene_list

    if not command.scenes:
        produce(command.config, command.out, classes=command.classes, preview=command.preview, report=report)
        return
    for config in configs:
        produce(config, command.out / f"{config.seed}", classes=True, report=report)
        write_scene_list(command.out)


def main() -> None:
    make(tyro.cli(Command, args=arguments_of(__file__), description=__doc__, prog="make_orchard.py"))


if __name__ == "__main__":
    run(main)
