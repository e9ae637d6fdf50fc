"""Mouse and keyboard of a Blender window, by Blender's own simulated events (`--enable-event-simulate`).

Everything here is a generator: each `yield` is the number of seconds before the next event. Buttons are found by moving
over the sidebar and asking Blender what is under the pointer, so no position is hard-coded.
"""

from __future__ import annotations

import subprocess
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Vector

Steps = Generator[float, None, Any]

STEP = 9
"""Pixels between two tested positions."""
WIDTH = 1280
"""Pixels of a picture."""
MOMENT = 0.06
"""Seconds that Blender needs to notice the pointer."""
PAGES, NOTCHES = 12, 5
"""How often the sidebar is scrolled, and by how many notches of the wheel, before a button counts as missing."""
SCROLLED = 1.5
"""Seconds that Blender needs to process a whole scroll; it notices pointer movements late in that time."""
KEYS = {" ": "SPACE", ",": "COMMA", ".": "PERIOD", "-": "MINUS"} | {
    str(digit): name
    for digit, name in enumerate(("ZERO", "ONE", "TWO", "THREE", "FOUR", "FIVE", "SIX", "SEVEN", "EIGHT", "NINE"))
}


LEFT, RIGHT = 0.25, 0.62
"""Positions across the sidebar, as shares of its width: of the first and the second button of a row; a single one is at
both."""


class NotThere(RuntimeError):
    """A button is not in the sidebar."""


class Hand:
    """Acts in one 3D viewport of a window. mouse: last position of the pointer, pixels of the window."""

    def __init__(self, window: bpy.types.Window, area: bpy.types.Area) -> None:
        self.window, self.area = window, area
        self.mouse: tuple[float, float] = (0.0, 0.0)
        self._black = False

    @property
    def aside(self) -> tuple[float, float]:
        """An empty position in the viewport."""
        region = self.region("WINDOW")
        return region.x + 0.15 * region.width, region.y + 0.1 * region.height

    def rest(self) -> Steps:
        """Move the pointer out of the sidebar."""
        yield from self.move(*self.aside)

    def region(self, kind: str) -> bpy.types.Region:
        return next(region for region in self.area.regions if region.type == kind)

    def move(self, x: float, y: float) -> Steps:
        """Move to a position in the window's pixels, from its lower left corner."""
        self.mouse = (x, y)
        self.window.event_simulate(type="MOUSEMOVE", value="NOTHING", x=int(x), y=int(y))
        yield MOMENT

    def click(self, x: float, y: float, **held: bool) -> Steps:
        """Press and release the left mouse button there; held: shift, ctrl, alt."""
        yield from self.move(x, y)
        for value in ("PRESS", "RELEASE"):
            self.window.event_simulate(type="LEFTMOUSE", value=value, x=int(x), y=int(y), **held)
            yield MOMENT

    def place_of(self, point: Vector) -> tuple[float, float]:
        """(x, y) in the window where a point of the world is drawn; far outside for one behind the viewer."""
        region = self.region("WINDOW")
        x, y = view3d_utils.location_3d_to_region_2d(
            region, self.area.spaces.active.region_3d, point, default=(-1e6, -1e6)
        )
        return region.x + x, region.y + y

    def press(self, key: str, x: float, y: float, **held: bool) -> Steps:
        """Press and release a key with the pointer there."""
        self.window.event_simulate(type=key, value="PRESS", x=int(x), y=int(y), **held)
        yield MOMENT
        self.window.event_simulate(type=key, value="RELEASE", x=int(x), y=int(y), **held)
        yield MOMENT

    def write(self, text: str, x: float, y: float) -> Steps:
        """Type a text into the field that is being edited, replacing its content, and finish with Enter."""
        yield from self.press("A", x, y, ctrl=True)
        for letter in text:
            key = KEYS.get(letter, letter.upper())
            self.window.event_simulate(type=key, value="PRESS", unicode=letter, x=int(x), y=int(y))
            yield MOMENT
            self.window.event_simulate(type=key, value="RELEASE", x=int(x), y=int(y))
            yield MOMENT
        yield from self.press("RET", x, y)

    def name_under_mouse(self) -> str:
        """Name the operator ('fruitlangs.count') or property ('prompt') of the button under the pointer; empty if there
        is none."""
        manager = bpy.context.window_manager
        manager.clipboard = ""
        with bpy.context.temp_override(window=self.window, area=self.area, region=self.region("UI")):
            for copy in (bpy.ops.ui.copy_python_command_button, bpy.ops.ui.copy_data_path_button):
                try:
                    if copy.poll() and copy() == {"FINISHED"}:
                        break
                except RuntimeError:
                    continue
        return manager.clipboard

    def find(self, what: str, across: float = RIGHT) -> Steps:
        """(x, y) in the window of the button of the sidebar for `what`: the first below the current position, or else
        from the top. across: share of the sidebar's width, for a row of several buttons.

        Raises:
            NotThere: there is none.
        """
        for _ in range(2):
            found = yield from self._find_below(what, across)
            if found is not None:
                return found
            yield from self.scroll_to_top()
        raise NotThere(f"no button '{what}' in the sidebar")

    def _find_below(self, what: str, across: float) -> Steps:
        """As `find`, below the current position; None if there is none."""
        region = self.region("UI")
        x = region.x + region.width * across
        for _ in range(PAGES):
            y = region.y + region.height - 2 * STEP
            while y > region.y + STEP:
                yield from self.move(x, y)
                if what in self.name_under_mouse():
                    return x, y - STEP // 2  # its very edge does not accept clicks
                y -= STEP
            for _ in range(NOTCHES):
                yield from self.press("WHEELDOWNMOUSE", x, region.y + region.height / 2)
        return None

    def scroll_to_top(self) -> Steps:
        """Scroll the sidebar to its top."""
        region = self.region("UI")
        for _ in range(60):
            self.window.event_simulate(
                type="WHEELUPMOUSE", value="PRESS", x=int(region.x + 30), y=int(region.y + region.height / 2)
            )
        yield SCROLLED

    def push(self, what: str, across: float = RIGHT) -> Steps:
        """Find a button and click it."""
        x, y = yield from self.find(what, across)
        yield from self.click(x, y)
        return x, y

    def save_shot(self, path: Path) -> Steps:
        """Save a picture of the whole window, `WIDTH` pixels wide, as JPEG."""
        yield 1.0
        path.parent.mkdir(parents=True, exist_ok=True)
        drawn = path.with_suffix(".part.png")
        self.draw_window(drawn)
        image = bpy.data.images.load(str(drawn))
        image.scale(WIDTH, round(WIDTH * image.size[1] / image.size[0]))
        image.file_format = "JPEG"
        image.save(filepath=str(path), quality=88)
        bpy.data.images.remove(image)
        drawn.unlink()
        yield MOMENT

    def draw_window(self, path: Path) -> None:
        """Save a picture of the whole window as PNG."""
        if not self._black:
            with bpy.context.temp_override(window=self.window):
                bpy.ops.screen.screenshot(filepath=str(path), check_existing=False)
            image = bpy.data.images.load(str(path))
            self._black = is_black(image)
            bpy.data.images.remove(image)
        if self._black:  # some drivers, software ones among them, do not return what they show; the display does
            subprocess.run(["import", "-window", "root", str(path)], check=True)


def is_black(image: bpy.types.Image) -> bool:
    """Whether a picture is completely black."""
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    return not pixels.reshape(-1, 4)[:, :3].any()
