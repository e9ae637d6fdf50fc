"""Measure how long Blender's window stands still while jobs run; run it inside Blender.

    "$FRUITLANGS_BLENDER" -P scripts/benchmark_stall.py -- --scene examples/orchard_tree --steps 300

It needs a display; a virtual one (xvfb-run) will do. A timer that wants to tick every hundredth of a second notes each
gap, with no job and then during Reconstruct and Count: what a job adds is the difference. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _checkout  # noqa: F401

import bpy
import numpy as np

import fruitlangs

TICK = 0.01
JOBS = ("import", "reconstruct", "count")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="benchmark_stall")
    parser.add_argument("--scene", type=Path, default=Path("examples/orchard_tree"))
    parser.add_argument("--prompt", default="apple")
    parser.add_argument("--steps", type=int, default=300, help="of training")
    parser.add_argument("--idle", type=float, default=20.0, help="seconds to watch with no job")
    return parser.parse_args(sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else [])


@dataclass
class Gaps:
    """Seconds between ticks, by what went on: {name: gaps}."""

    found: dict[str, list[float]] = field(default_factory=dict)
    name: str = ""
    last: float = 0.0

    def watch(self, name: str) -> None:
        """From now on the gaps are of this; '' for none."""
        self.name, self.last = name, time.perf_counter()

    def tick(self) -> float:
        """The timer."""
        from fruitlangs.operators import jobs

        now, job = time.perf_counter(), jobs.running()
        if self.name:
            # What comes after the thread has ended is Blender's own: objects made, shaders compiled, the window drawn.
            shown = self.name in JOBS and (job is None or job.ended)
            self.found.setdefault(f"{self.name}: its result shown" if shown else self.name, []).append(now - self.last)
        self.last = now
        return TICK

    def table(self) -> str:
        """In Markdown, milliseconds."""
        rows = ["| while | seconds | middle ms | 99 % ms | longest ms |", "|---|---|---|---|---|"]
        for name, gaps in self.found.items():
            middle, most, longest = 1e3 * np.quantile(gaps, [0.5, 0.99, 1.0])
            rows.append(f"| {name} | {sum(gaps):.0f} | {middle:.0f} | {most:.0f} | {longest:.0f} |")
        return "\n".join(rows)


def visit(arguments: argparse.Namespace, gaps: Gaps) -> Iterator[float]:
    """Each yield lets the window live on for so many seconds."""
    from fruitlangs.operators import jobs

    def work(name: str, title: str) -> Iterator[float]:
        with bpy.context.temp_override(window=window, area=area, region=region):
            getattr(bpy.ops.fruitlangs, name)("INVOKE_DEFAULT")
        while jobs.running() is None:
            yield TICK
        gaps.watch(title)
        while jobs.running() is not None:
            yield 0.05
        gaps.watch("")
        yield 3.0
        if settings().error:
            raise RuntimeError(settings().error)

    def settings() -> Any:
        return window.scene.fruitlangs

    fruitlangs.register()
    bpy.data.batch_remove(list(bpy.data.objects))
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    area.spaces.active.show_region_ui = True
    region = next(region for region in area.regions if region.type == "WINDOW")
    yield 2.0
    next(region for region in area.regions if region.type == "UI").active_panel_category = "Fruit"
    settings().source, settings().prompt = str(arguments.scene.resolve()), arguments.prompt
    settings().out = str(Path(tempfile.mkdtemp()) / "result")
    settings().config.train.steps = arguments.steps
    yield 3.0
    gaps.watch("no job")
    yield arguments.idle
    gaps.watch("")
    yield from work("import_scene", "import")
    yield from work("reconstruct", "reconstruct")
    yield from work("count", "count")
    print(gaps.table(), flush=True)


def main() -> None:
    bpy.context.preferences.view.show_splash = False
    gaps = Gaps()
    actions = visit(parse(), gaps)

    def act() -> float | None:
        try:
            return next(actions)
        except StopIteration:
            code = 0
        except BaseException:
            traceback.print_exc()
            code = 1
        sys.stdout.flush()
        os._exit(code)  # no question whether to save

    bpy.app.timers.register(act, first_interval=1.5, persistent=True)
    bpy.app.timers.register(gaps.tick, persistent=True)


if __name__ == "__main__":
    main()
