"""Build a synthetic fruit tree in Blender, render a walk around it, and write the scene with its truth.

    python scripts/make_orchard.py --out results/orchard
    blender -b --factory-startup --python-exit-code 1 -P scripts/make_orchard.py -- --out results/orchard

Writes images/, a COLMAP model in sparse/0/, instances/ (16-bit masks of fruit ids), truth.json and orchard.json.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

sys.path.insert(0, str(Path(__file__).resolve().parent))

try:
    import tyro
except ImportError:
    sys.exit("make_orchard: this Python lacks tyro; install it with: python -m pip install tyro pycolmap")

from orchard.config import OrchardConfig, training_config
from orchard.errors import OrchardError


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
    """FIRST:LAST, the seeds of a training set of small close-up scenes; all seeds from 1000 up."""

    config: Annotated[OrchardConfig, tyro.conf.OmitArgPrefixes] = field(default_factory=OrchardConfig)


def arguments() -> list[str]:
    """What follows the script's name, under Python or after Blender's `--`."""
    if Path(sys.argv[0]).suffix == ".py":
        return sys.argv[1:]
    return sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []


def report(message: str) -> None:
    """Tell how far it is: one line a step, on stderr."""
    print(message, file=sys.stderr, flush=True)


def seeds_of(scenes: str) -> range:
    """The seeds that FIRST:LAST names, both included."""
    first, _, last = scenes.partition(":")
    if not (first.isdecimal() and last.isdecimal()) or int(first) < 1000 or int(last) < int(first):
        raise OrchardError(f"--scenes {scenes}: give FIRST:LAST with 1000 <= FIRST <= LAST, such as 1000:1059")
    return range(int(first), int(last) + 1)


def run(command: Command) -> None:
    """Make the scene, or every scene of the training set."""
    from orchard.check import check
    from orchard.produce import produce, write_scene_list

    if not command.scenes:
        check(command.config)
        produce(command.config, command.out, classes=command.classes, preview=command.preview, report=report)
        return
    for seed in seeds_of(command.scenes):
        config = training_config(seed)
        produce(config, command.out / f"{seed}", classes=True, report=report)
        write_scene_list(command.out)


def main() -> int:
    """The exit code: 0 done, 1 an error named on stderr."""
    command = tyro.cli(Command, args=arguments(), description=__doc__, prog="make_orchard.py")
    try:
        run(command)
    except OrchardError as error:
        report(f"make_orchard: {error}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
