"""Build synthetic fruit trees in Blender, render a walk around them, and write the scene with its truth.

    python scripts/make_orchard.py --out results/orchard
    python scripts/make_orchard.py --scene apple-small --seed 5 --out results/apple
    blender -b --factory-startup --python-exit-code 1 -P scripts/make_orchard.py -- --out results/orchard

Writes images/, a COLMAP model in sparse/0/, instances/ (16-bit masks of fruit ids), depth/ (16-bit millimetres along
the optical axis, 0: nothing), truth.json and orchard.json. A scene file is TOML: a setting a line by its flag's name
with underscores; `extends` names the scene that it starts from, `about` says what it is for. A killed run goes on.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

from _terminal import arguments_of, import_tyro, report, run
from fruitlangs.orchard.check import check
from fruitlangs.orchard.config import FIRST_TRAINING_SEED, OrchardConfig
from fruitlangs.orchard.errors import OrchardError
from fruitlangs.orchard.scene_file import find_scene, presets, read_scene
from fruitlangs.orchard.training_scenes import training_config

if TYPE_CHECKING:
    import tyro
else:
    tyro = import_tyro()


@dataclass(frozen=True, kw_only=True)
class Command:
    """Generate synthetic fruit trees in Blender and render photos around them."""

    out: Path
    """Folder to write; with --scenes the folder of many scenes."""

    scene: str = ""
    """A scene file (TOML) or the name of a preset; flags override its settings."""

    list: bool = False
    """Print the presets, one per line, and end."""

    layout: Literal["colmap", "nerfstudio"] = "colmap"
    """nerfstudio: also transforms.json, semantics/ (255 on fruit) and sparse_pc.ply, as FruitNeRF reads them."""

    classes: bool = False
    """Also write classes/ and classes.json, the class of every pixel, for training an image encoder."""

    preview: int = 0
    """Render only this many views of the camera path; 0: all."""

    scenes: str = ""
    """FIRST:LAST, the seeds of a training set, from 1000 up: small scenes, two in five close-ups and three in five
    whole trees; their other settings are random by seed."""

    config: Annotated[OrchardConfig, tyro.conf.OmitArgPrefixes] = field(default_factory=OrchardConfig)


def scene_config(arguments: list[str]) -> OrchardConfig:
    """The default settings: those of --scene, else the defaults."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--scene", nargs="?", default="")
    scene = parser.parse_known_args(arguments)[0].scene
    return read_scene(find_scene(scene)).config if scene else OrchardConfig()


def print_presets() -> None:
    """One line per preset on stdout."""
    scenes = presets()
    width = max((len(scene.name) for scene in scenes), default=0)
    for scene in scenes:
        print(f"{scene.name:{width}}  {scene.about}")


def seeds_of(scenes: str) -> range:
    """The seeds of FIRST:LAST, both included."""
    first, _, last = scenes.partition(":")
    if not (first.isdecimal() and last.isdecimal()) or not FIRST_TRAINING_SEED <= int(first) <= int(last):
        low = FIRST_TRAINING_SEED
        raise OrchardError(f"--scenes {scenes}: give FIRST:LAST with {low} <= FIRST <= LAST, such as {low}:{low + 59}")
    return range(int(first), int(last) + 1)


def make(command: Command) -> None:
    """Generate the scene, or every scene of the training set."""
    if command.scene and command.scenes:
        raise OrchardError("--scenes draws its own scenes: leave out --scene")
    configs = list(map(training_config, seeds_of(command.scenes))) if command.scenes else [command.config]
    for config in configs:
        check(config)
    if command.preview < 0:
        raise OrchardError(f"--preview is {command.preview}: give the number of views, or 0 for all")
    for package in ("bpy", "pycolmap"):
        if importlib.util.find_spec(package) is None:
            install = f'"{sys.executable}" -m pip install {package}'
            raise OrchardError(f"The package {package} is missing in this Python. Run: {install}")
    from fruitlangs.orchard.produce import produce, write_scene_list

    if not command.scenes:
        produce(
            command.config,
            command.out,
            classes=command.classes,
            preview=command.preview,
            layout=command.layout,
            report=report,
        )
        return
    for config in configs:
        produce(config, command.out / f"{config.seed}", classes=True, layout=command.layout, report=report)
        write_scene_list(command.out)


def main() -> None:
    arguments = arguments_of(__file__)
    if "--list" in arguments:
        print_presets()
        return
    start = Command(out=tyro.MISSING, config=scene_config(arguments))
    make(tyro.cli(Command, args=arguments, default=start, description=__doc__, prog="make_orchard.py"))


if __name__ == "__main__":
    run(main)
