"""Live through a day in Blender's window by clicks and keys, for the user guide's pictures; run it inside Blender.

    "$FRUITLANGS_BLENDER" --enable-event-simulate -P scripts/picture_guide.py -- --pictures docs/images/guide

It needs a display; a virtual one (xvfb-run) will do. What is untrue on the way is printed, and the exit code is then 1.
With --folder the copy of the scene and the results are kept there, and a second run reuses them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

import bpy
from guide.day import Day, live
from guide.hand import Hand

import fruitlangs

TRIES = 20


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
    return parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])


def visit(arguments: argparse.Namespace, untrue: list[str]) -> Iterator[float]:
    """The day in this window; each yield gives it so many seconds."""
    fruitlangs.register()
    bpy.data.batch_remove(list(bpy.data.objects))
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    area.spaces.active.show_region_ui = True
    sidebar = next(region for region in area.regions if region.type == "UI")
    for _ in range(TRIES):  # it takes no tab before it was drawn for the first time
        yield 0.5
        sidebar.active_panel_category = "Fruit"
        yield 0.5
        if sidebar.active_panel_category == "Fruit":
            break
    folder = (arguments.folder or Path(tempfile.mkdtemp())).resolve()
    scene = folder / arguments.scene.name
    shutil.copytree(arguments.scene, scene, dirs_exist_ok=True)

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
    yield from live(Hand(window, area), day)


def main() -> None:
    bpy.context.preferences.view.show_splash = False
    untrue: list[str] = []
    actions = visit(parse(), untrue)

    def tick() -> float | None:
        try:
            return next(actions)
        except StopIteration:
            code = 1 if untrue else 0
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        os._exit(code)  # no question whether to save

    bpy.app.timers.register(tick, first_interval=1.5, persistent=True)


if __name__ == "__main__":
    main()
