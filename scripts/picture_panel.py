"""Count a scene through the Fruit tab of a Blender window and keep a picture of it; run it inside Blender.

    "$FRUITLANGS_BLENDER" -P scripts/picture_panel.py -- --scene examples/orchard_tree --out docs/images/fruit_tab.jpg

It imports, counts as a click on the button does, waits, takes the picture and quits. A display is needed; a virtual one
(Xvfb) will do. With --folder the copy of the scene and the results are kept there, and a second run reuses them.
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

import fruitlangs

WIDTH = 1280
"""Pixels of the picture."""


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="picture_panel")
    parser.add_argument("--scene", type=Path, default=Path("examples/orchard_tree"))
    parser.add_argument("--prompt", default="apple")
    parser.add_argument("--steps", type=int, help="training steps (default: the panel's)")
    parser.add_argument("--downscale", type=float, help="divide the photos' size (default: the panel's)")
    parser.add_argument("--folder", type=Path, help="where to work (default: a temporary folder)")
    parser.add_argument("--out", type=Path, default=Path("docs/images/fruit_tab.jpg"))
    parser.add_argument("--draw-seconds", type=float, default=45.0, help="time for the viewport's first drawing")
    return parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])


def visit(arguments: argparse.Namespace) -> Iterator[float]:
    """What a person would do; each yield gives the window so many seconds."""
    from fruitlangs.operators import jobs

    fruitlangs.register()
    bpy.data.batch_remove(list(bpy.data.objects))
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    area.spaces.active.show_region_ui = True
    yield 1.0
    next(region for region in area.regions if region.type == "UI").active_panel_category = "Fruit"
    settings = window.scene.fruitlangs
    folder = (arguments.folder or Path(tempfile.mkdtemp())).resolve()
    scene = folder / arguments.scene.name
    shutil.copytree(arguments.scene, scene, dirs_exist_ok=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "orchard.blend"))
    settings.source, settings.prompt = f"//{scene.name}", arguments.prompt  # as the file browser stores it
    settings.config.train.steps = arguments.steps or settings.config.train.steps
    settings.config.scene.downscale = arguments.downscale or settings.config.scene.downscale
    region = next(region for region in area.regions if region.type == "WINDOW")
    for operator in (bpy.ops.fruitlangs.import_scene, bpy.ops.fruitlangs.count):
        with bpy.context.temp_override(window=window, area=area, region=region):
            operator("INVOKE_DEFAULT")
        while jobs.running() is not None:
            yield 0.5
        yield 2.0
        if settings.error:
            raise RuntimeError(settings.error)
    print(f"{settings.result.label}: {settings.result.count}")
    yield arguments.draw_seconds
    with bpy.context.temp_override(window=window, area=area, region=region):
        take_picture(arguments.out)


def take_picture(path: Path) -> None:
    """The whole window as a JPEG, `WIDTH` pixels wide."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shot = path.resolve().with_suffix(".part.png")
    bpy.ops.screen.screenshot(filepath=str(shot), check_existing=False)
    image = bpy.data.images.load(str(shot))
    image.scale(WIDTH, round(WIDTH * image.size[1] / image.size[0]))
    image.file_format = "JPEG"
    image.save(filepath=str(path.resolve()), quality=88)
    shot.unlink()


def main() -> None:
    bpy.context.preferences.view.show_splash = False
    actions = visit(parse())

    def tick() -> float | None:
        try:
            return next(actions)
        except StopIteration:
            code = 0
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        os._exit(code)  # no question whether to save

    bpy.app.timers.register(tick, first_interval=1.5, persistent=True)


if __name__ == "__main__":
    main()
