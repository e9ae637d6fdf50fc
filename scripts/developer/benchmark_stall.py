"""Measure how long Blender's window stands still while jobs run; run it inside Blender.

    "$FRUITLANGS_BLENDER" -P scripts/developer/benchmark_stall.py -- --scene examples/orchard_tree --steps 300

It needs a display; a virtual one (xvfb-run) will do. A timer that wants to tick every hundredth of a second notes each
gap, with no job and then during Reconstruct and Count: what a job adds is the difference. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import _checkout  # noqa: F401

import bpy
import numpy as np

from _window import arguments_of, find_viewport, open_panel, play, region_of

TICK = 0.01
JOBS = ("import", "reconstruct", "count")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="benchmark_stall")
    parser.add_argument("--scene", type=Path, default=Path("examples/orchard_tree"))
    parser.add_argument("--prompt", default="apple")
    parser.add_argument("--steps", type=int, default=300, help="of training")
    parser.add_argument("--idle", type=float, default=20.0, help="seconds to watch with no job")
    return parser.parse_args(arguments_of())


@dataclass
class Gaps:
    """Seconds between ticks, by activity: {name: gaps}."""

    found: dict[str, list[float]] = field(default_factory=dict)
    name: str = ""
    last: float = 0.0

    def watch(self, name: str) -> None:
        """From now on the gaps belong to this activity; '' for none."""
        self.name, self.last = name, time.perf_counter()

    def tick(self) -> float:
        """The timer."""
        from fruitlangs.operators.jobs import jobs

        now, job = time.perf_counter(), jobs.find_running_job()
        if self.name:
            # After the thread has ended, Blender itself works: creating objects, compiling shaders, drawing the window.
            shown = self.name in JOBS and (job is None or job.ended)
            self.found.setdefault(f"{self.name}: its result shown" if shown else self.name, []).append(now - self.last)
        self.last = now
        return TICK

    def format_table(self) -> str:
        """In Markdown, milliseconds."""
        rows = ["| while | seconds | middle ms | 99 % ms | longest ms |", "|---|---|---|---|---|"]
        for name, gaps in self.found.items():
            middle, most, longest = 1e3 * np.quantile(gaps, [0.5, 0.99, 1.0])
            rows.append(f"| {name} | {sum(gaps):.0f} | {middle:.0f} | {most:.0f} | {longest:.0f} |")
        return "\n".join(rows)


def visit(arguments: argparse.Namespace, gaps: Gaps) -> Generator[float, None, None]:
    """Each yield gives the window this many seconds."""
    from fruitlangs.operators.jobs import jobs

    def work(name: str, title: str) -> Iterator[float]:
        with bpy.context.temp_override(window=window, area=area, region=region):
            getattr(bpy.ops.fruitlangs, name)("INVOKE_DEFAULT")
        while jobs.find_running_job() is None:
            yield TICK
        gaps.watch(title)
        while jobs.find_running_job() is not None:
            yield 0.05
        gaps.watch("")
        yield 3.0
        if settings().error:
            raise RuntimeError(settings().error)

    def settings() -> Any:
        return window.scene.fruitlangs

    yield from open_panel()
    window, area = find_viewport()
    region = region_of(area, "WINDOW")
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
    print(gaps.format_table(), flush=True)


if __name__ == "__main__":
    watched = Gaps()
    play(visit(parse(), watched))
    bpy.app.timers.register(watched.tick, persistent=True)
