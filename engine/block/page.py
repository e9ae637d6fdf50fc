"""The page of a block: sums, a map, a table and a picture of each tree; to be read in a browser or printed."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, Template, select_autoescape

from ..storage.files import write_text
from .ledger import TREES
from .totals import SHARED_ALL, SHARED_VISIBLE
from .trees import CountedTree

PAGE, STILL, REPORT = "orchard.html", "still.jpg", "report.html"
WIDTH, HEIGHT, MARGIN, LARGEST = 900.0, 420.0, 40.0, 16.0
"""Of the map, in its units."""
MOST_STILLS = 200
"""Pictures on a page."""


def write_page(
    folder: Path, trees: Sequence[CountedTree], rows: Sequence[dict[str, Any]], document: Mapping[str, Any]
) -> Path:
    """Write orchard.html into a block's folder; returns its path. rows, document: from `tables.rows_of` and
    `tables.summary`.

    Raises:
        OutputError: the folder cannot be written.
    """
    marks, places = _marks(trees)
    text = _template().render(
        **document,
        whole=document,
        title=folder.resolve().name or "orchard",
        table=rows,
        marks=marks,
        places=places,
        width=WIDTH,
        height=HEIGHT,
        stills=_stills(folder, trees),
        shared_visible=SHARED_VISIBLE,
        shared_all=SHARED_ALL,
        size=lambda value, unit: f"{1000.0 * value:.1f} mm" if unit == "m" else f"{value:.4g} {unit}",
    )
    write_text(folder / PAGE, text)
    return folder / PAGE


@cache
def _template() -> Template:
    environment = Environment(autoescape=select_autoescape(default=True), trim_blocks=True)
    return environment.from_string(Path(__file__).with_suffix(".html").read_text(encoding="utf-8"))


def _stills(folder: Path, trees: Sequence[CountedTree]) -> list[dict[str, str]]:
    counts: dict[str, int] = {}
    for tree in trees:
        if tree.count is not None and (folder / TREES / tree.folder / STILL).is_file():
            counts[tree.folder] = counts.get(tree.folder, 0) + tree.count
    found = []
    for own, count in list(counts.items())[:MOST_STILLS]:
        base = f"{TREES}/{quote(own)}"
        found.append({"picture": f"{base}/{STILL}", "report": f"{base}/{REPORT}", "text": f"{own}: {count} fruit"})
    return found


def _marks(trees: Sequence[CountedTree]) -> tuple[list[dict[str, Any]], str]:
    """The circles of the map, and what their places are; none without places."""
    entries = [tree.entry for tree in trees]
    if all(entry.latitude is not None and entry.longitude is not None for entry in entries):
        shrink = math.cos(math.radians(sum(entry.latitude or 0.0 for entry in entries) / max(len(entries), 1)))
        places = [((entry.longitude or 0.0) * shrink, -(entry.latitude or 0.0)) for entry in entries]
        what, alike = "North is up", True
    elif all(entry.position is not None for entry in entries):
        rows = list(dict.fromkeys(entry.row for entry in entries))
        places = [(entry.position or 0.0, float(rows.index(entry.row))) for entry in entries]
        what, alike = "Positions along the rows", False  # rows are drawn as far apart as there is room
    else:
        return [], ""
    most = max((tree.count or 0 for tree in trees), default=0)
    xs, ys = zip(*places, strict=True)
    wide, high = max(xs) - min(xs), max(ys) - min(ys)
    scale_x, scale_y = (WIDTH - 2 * MARGIN) / (wide or 1.0), (HEIGHT - 2 * MARGIN) / (high or 1.0)
    if alike:
        scale_x = scale_y = min(scale_x, scale_y)
    marks = []
    for tree, x, y in zip(trees, xs, ys, strict=True):
        count = tree.count or 0
        failed = tree.state.stage == "failed"
        marks.append(
            {
                "id": tree.entry.id,
                "x": MARGIN + (x - min(xs)) * scale_x,
                "y": MARGIN + (y - min(ys)) * scale_y,
                "radius": LARGEST * math.sqrt(count / most) if most and count else 4.0,
                "color": "#c33" if failed else "#bbb" if tree.count is None else "#2c7a2c",
                "text": f"{tree.entry.id}: {tree.state.reason if failed else _count_text(tree)}",
            }
        )
    return marks, what


def _count_text(tree: CountedTree) -> str:
    return "not counted yet" if tree.count is None else f"{tree.count} fruit"
