"""Take the pictures of the user guide: a day of work in Blender's window by clicks and keys; run it inside Blender.

    "$FRUITLANGS_BLENDER" --enable-event-simulate -P scripts/developer/picture_guide.py -- --pictures docs/images/guide
    … --film docs/images/guide/day.webp      # also a film of 90 s

It needs a display; a virtual one (xvfb-run) will do. A check that fails is printed, and the exit code is then 1.
With --folder the copy of the scene and the results are kept there, and a second run reuses them.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import _checkout  # noqa: F401

from guide.day import Day, live
from guide.film import Film
from guide.hand import Hand

from _window import arguments_of, find_viewport, open_panel, play


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="picture_guide")
    parser.add_argument("--scene", type=Path, default=Path("examples/orchard_tree"))
    parser.add_argument("--prompt", default="apple")
    parser.add_argument("--other", default="leaf", help="what is asked first")
    parser.add_argument("--steps", type=int, help="training steps (default: the panel's)")
    parser.add_argument("--downscale", type=float, help="divide the photos' size (default: the panel's)")
    parser.add_argument("--threshold", type=float, help="of the probability (default: the panel's)")
    parser.add_argument("--folder", type=Path, help="where to work (default: a temporary folder)")
    parser.add_argument("--pictures", type=Path, help="folder of the pictures (default: none are kept)")
    parser.add_argument("--film", type=Path, help="an animated WebP file of the day (default: none)")
    return parser.parse_args(arguments_of())


def visit(arguments: argparse.Namespace) -> Generator[float, None, int]:
    """The day in this window."""
    yield from open_panel()
    folder = (arguments.folder or Path(tempfile.mkdtemp())).resolve()
    scene = folder / arguments.scene.name
    shutil.copytree(arguments.scene, scene, dirs_exist_ok=True)
    untrue: list[str] = []

    def check(what: str, true: bool) -> None:
        print(f"{'ok' if true else 'NOT TRUE'}: {what}", flush=True)
        if not true:
            untrue.append(what)

    day = Day(
        scene=scene,
        work=folder,
        prompt=arguments.prompt,
        other=arguments.other,
        steps=arguments.steps,
        downscale=arguments.downscale,
        threshold=arguments.threshold,
        pictures=arguments.pictures and arguments.pictures.resolve(),
        check=check,
    )
    hand = Hand(*find_viewport())
    film = Film(hand) if arguments.film else None
    yield from live(hand, day, film)
    if film is not None:
        film.write(arguments.film.resolve())
    return 1 if untrue else 0


if __name__ == "__main__":
    play(visit(parse()))
