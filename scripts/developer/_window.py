"""What all scripts in a Blender window share: arguments, time for the window, the sidebar, the end."""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Generator, Iterator

import bpy

import fruitlangs

TRIES = 20


def arguments_of() -> list[str]:
    """The script's own arguments, under `blender -P script -- …`."""
    return sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else []


def play(actions: Generator[float, None, int | None]) -> None:
    """Run `actions` in the window, which gets the yielded number of seconds after each step, then quit Blender.

    The exit code is what `actions` returns, or 1 after an exception, which is printed.
    """
    bpy.context.preferences.view.show_splash = False

    def tick() -> float | None:
        try:
            return next(actions)
        except StopIteration as end:
            code = end.value or 0
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        os._exit(code)  # do not ask whether to save

    bpy.app.timers.register(tick, first_interval=1.5, persistent=True)


def find_viewport() -> tuple[bpy.types.Window, bpy.types.Area]:
    """Find the first window and its 3D viewport."""
    window = bpy.context.window_manager.windows[0]
    return window, next(area for area in window.screen.areas if area.type == "VIEW_3D")


def region_of(area: bpy.types.Area, kind: str) -> bpy.types.Region:
    return next(region for region in area.regions if region.type == kind)


def open_panel() -> Iterator[float]:
    """Register this checkout's add-on in an empty file and open its tab in the sidebar."""
    fruitlangs.register()
    bpy.data.batch_remove(list(bpy.data.objects))
    _, area = find_viewport()
    area.spaces.active.show_region_ui = True
    sidebar = region_of(area, "UI")
    for _ in range(TRIES):  # it accepts no tab before it was drawn for the first time
        yield 0.5
        sidebar.active_panel_category = "Fruit"
        yield 0.5
        if sidebar.active_panel_category == "Fruit":
            break
