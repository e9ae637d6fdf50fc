"""Measure what Gaussians cost in Blender's window: sorting, redrawing, highlighting, saving; run it inside Blender.

    "$FRUITLANGS_BLENDER" -P scripts/developer/benchmark_window.py -- --gaussians 20000 100000 500000 --out window.json

It needs a display; a virtual one (xvfb-run) will do, but draws without a graphics card. Prints a table in Markdown;
with --out the rows are also written as JSON. Times vary between runs and machines, so compare within one.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parent)]

import _checkout  # noqa: F401

import bpy
import numpy as np
from mathutils import Quaternion

import fruitlangs
from _window import arguments_of, find_viewport, play

COUNTS = (20_000, 100_000, 500_000)
ATTRIBUTES = ("position", "scale", "quaternion", "radiance:base", "opacity", "probability", "fruit_id")


@dataclass(frozen=True, kw_only=True)
class Row:
    """Figures for one number of Gaussians. *_ms: milliseconds; redraw_*: seconds per redraw of the whole window, for a
    view that stays (empty, splats, ellipsoids or points in Solid) or rotates by a degree each time (turning); read_ms:
    from the mesh to the card; highlight_ms: from a new answer until it is drawn; blend_mb: the saved file; same:
    whether all attributes come back from it."""

    gaussians: int
    write_ms: float
    read_ms: float
    sort_ms: float
    upload_ms: float
    redraw_empty: float
    redraw_splats: float
    redraw_turning: float
    redraw_ellipsoids: float
    highlight_ms: float
    blend_mb: float
    same: bool


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="benchmark_window")
    parser.add_argument("--gaussians", type=int, nargs="+", default=list(COUNTS), help="numbers of Gaussians")
    parser.add_argument("--repeats", type=int, default=5, help="of each figure, of which the median (default 5)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the rows there as JSON")
    return parser.parse_args(arguments_of())


def make_tree(count: int) -> Any:
    """Make engine Gaussians similar to a tree: a crown of flat leaves 2 m wide on a trunk, fruit among them, and
    ground."""
    import torch

    from fruitlangs.engine.splatting.gaussians import Gaussians, harmonics_of, logit

    random = np.random.default_rng(count)
    kind = random.choice(3, count, p=(0.75, 0.05, 0.2))  # leaf, fruit, ground
    crown = random.normal(size=(count, 3))
    crown *= random.uniform(0.2, 1.0, (count, 1)) ** (1 / 3) / np.linalg.norm(crown, axis=1, keepdims=True)
    ground = np.concatenate([random.uniform(-2, 2, (count, 2)), np.zeros((count, 1))], axis=1)
    means = np.where(kind[:, None] == 2, ground, crown + [0.0, 0.0, 1.6])
    size = 2.5 / count ** (1 / 2)
    scales = size * random.uniform(0.5, 1.5, (count, 3)) * np.where(kind[:, None] == 1, 1.0, [1.0, 1.0, 0.2])
    colors = np.array([(0.25, 0.45, 0.15), (0.75, 0.15, 0.1), (0.45, 0.4, 0.3)])[kind]
    colors = np.clip(colors * random.uniform(0.6, 1.3, (count, 1)), 0, 1)
    return Gaussians(
        means=torch.from_numpy(means).float(),
        log_scales=torch.from_numpy(np.log(scales)).float(),
        quats=torch.from_numpy(random.normal(size=(count, 4))).float(),
        opacity_logits=torch.from_numpy(random.uniform(logit(0.1), logit(0.98), count)).float(),
        sh=harmonics_of(colors),
    )


def time_action(action: Callable[[], Any], repeats: int) -> float:
    """Measure the median duration of an action."""
    found = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        found.append(time.perf_counter() - start)
    return median(found)


def redraw() -> None:
    """Draw the window and wait until the card has finished."""
    bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def measure(count: int, repeats: int, folder: Path) -> Iterator[float | Row]:
    """Figures for one number of Gaussians; yields the seconds that the window needs."""
    from fruitlangs.operators.blender_data import ensure_owned_collection, get_attribute, make_object, set_attribute
    from fruitlangs.operators.data.write_gaussians import make_gaussian_mesh
    from fruitlangs.operators.drawing import splat_drawing
    from fruitlangs.operators.drawing.splat_order import sort_back_to_front
    from fruitlangs.operators.drawing.splat_textures import SplatTextures, make_order_texture
    from fruitlangs.operators.viewport.appearance import apply_appearance
    from fruitlangs.operators.viewport.gaussian_nodes import gaussian_node_group
    from fruitlangs.operators.viewport.splats import splats_of_mesh

    bpy.ops.wm.read_homefile(app_template="", use_empty=False)
    yield 0.5
    bpy.data.batch_remove(list(bpy.data.objects))
    bpy_scene = bpy.context.scene
    _, area = find_viewport()
    view = area.spaces.active.region_3d
    view.view_location, view.view_distance = (0.0, 0.0, 1.2), 6.0
    random = np.random.default_rng(1)
    answers = [random.uniform(0, 1, count).astype(np.float32) ** 4 for _ in range(2)]
    gaussians = make_tree(count)

    start = time.perf_counter()
    mesh = make_gaussian_mesh(gaussians, answers[0], ())
    write = time.perf_counter() - start
    item = make_object("Gaussians", mesh, "gaussians", ensure_owned_collection(bpy_scene, "scene", "FruitLangs"), None)
    item.modifiers.new("Gaussians", "NODES").node_group = gaussian_node_group()
    settings = bpy_scene.fruitlangs

    def time_redraws(style: str) -> float:
        settings.look.style = style
        apply_appearance(bpy_scene)
        redraw()
        return time_action(redraw, repeats)

    def turn() -> None:
        view.view_rotation = view.view_rotation @ Quaternion((0.0, 1.0, 0.0), np.radians(1.0))
        redraw()

    def answer() -> None:
        answers.reverse()
        set_attribute(mesh, "probability", "FLOAT", answers[0])
        mesh.update()
        redraw()

    def read_mesh() -> Any:
        splats = splats_of_mesh(mesh)
        assert splats is not None
        return SplatTextures(splats, (0.0, 0.0, 0.0), 1e9)

    empty = time_redraws("NONE")
    splats = time_redraws("SPLATS")
    if splat_drawing.explain_problem():
        raise RuntimeError(splat_drawing.explain_problem())
    turning = time_action(turn, repeats)
    highlight = time_action(answer, repeats)
    ellipsoids = time_redraws("ELLIPSOIDS")
    settings.look.style = "SPLATS"

    values = splats_of_mesh(mesh)
    assert values is not None
    order = sort_back_to_front(values.means, (1.0, 2.0, 3.0))
    read = time_action(read_mesh, repeats)
    sorting = time_action(lambda: sort_back_to_front(values.means, random.normal(size=3).tolist()), repeats)
    upload = time_action(lambda: make_order_texture(order), repeats)

    before = {name: get_attribute(mesh, name) for name in ATTRIBUTES}
    file = folder / f"{count}.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(file), compress=True)
    bpy.ops.wm.open_mainfile(filepath=str(file))
    yield 0.5
    mesh = next(item for item in bpy.context.scene.objects if item.get("fruitlangs") == "gaussians").data
    same = all(np.array_equal(get_attribute(mesh, name), values) for name, values in before.items())
    yield Row(
        gaussians=count,
        write_ms=1e3 * write,
        read_ms=1e3 * read,
        sort_ms=1e3 * sorting,
        upload_ms=1e3 * upload,
        redraw_empty=empty,
        redraw_splats=splats,
        redraw_turning=turning,
        redraw_ellipsoids=ellipsoids,
        highlight_ms=1e3 * highlight,
        blend_mb=file.stat().st_size / 2**20,
        same=same,
    )


def format_table(rows: list[Row]) -> str:
    """Write the rows in Markdown."""
    names = list(asdict(rows[0]))
    lines = [f"| {' | '.join(names)} |", f"|{'---|' * len(names)}"]
    for row in rows:
        lines.append(f"| {' | '.join(format_cell(value) for value in asdict(row).values())} |")
    return "\n".join(lines)


def format_cell(value: bool | int | float) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else f"{value:,}"


def visit(arguments: argparse.Namespace) -> Generator[float, None, None]:
    """All numbers of Gaussians, one after the other."""
    fruitlangs.register()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for count in arguments.gaussians:
            for step in measure(count, arguments.repeats, Path(folder)):
                if isinstance(step, Row):
                    rows.append(step)
                else:
                    yield step
    print(format_table(rows), flush=True)
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        text = json.dumps({"blender": bpy.app.version_string, "rows": [asdict(row) for row in rows]}, indent=1)
        arguments.out.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    play(visit(parse()))
