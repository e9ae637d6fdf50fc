"""`report.html`: one page that presents a count and prints well, without other files or network."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

from ..counting.fruit import KIND_TEXTS, Fruit, FruitCount, Tree
from ..errors import OutputError
from ..storage.files import write_text
from .histogram import drawing, histogram
from .meshes import id_color
from .provenance import versions
from .still import jpeg
from .tables import fruit_cells, fruit_heads, size_lines
from .words import audit_reason, count_text, explain_nothing_found, length_unit, location_text

_STRIP_WIDTH = 1600
"""Width in pixels of a strip on the page; wider ones are scaled down."""
REASONS = 3
"""Number of clusters listed as reasons for a count of 0."""


@dataclass(frozen=True, kw_only=True)
class Reviewed:
    """What the user decided.

    line: the count after the review, in words; interval: its 90 % interval; decisions: one line each.
    """

    line: str
    interval: tuple[int, int] | None
    decisions: Sequence[str]


def write_page(
    path: Path,
    fruit_count: FruitCount,
    *,
    title: str,
    metres_per_unit: float | None,
    still: Image.Image | None,
    strips: Sequence[Path] = (),
    reviewed: Reviewed | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> None:
    """Write the page, atomically.

    Args:
        title: over the page, as it is.
        still: of `draw_still`.
        strips: files of pictures to show further down.
        provenance: the content of "How it was made", nested values. Two names in it are special:
            `notices`, sentences shown at the top, and `config` with the settings, whose threshold explains a zero.

    Raises:
        OutputError: the page cannot be written, or a strip cannot be read.
    """
    given = dict(provenance or {})
    notices = list(given.pop("notices", ()))
    sizes = fruit_count.diameters * length_unit(metres_per_unit)[1]
    axis = f"diameter ({length_unit(metres_per_unit)[0]})"
    text = _template().render(
        title=title,
        count=fruit_count.count,
        count_text=count_text(fruit_count),
        reason=None if fruit_count.fruits else _zero(fruit_count, given, metres_per_unit),
        notices=notices,
        facts=[*location_text(fruit_count), *size_lines(fruit_count, metres_per_unit)] if fruit_count.fruits else [],
        reviewed=reviewed,
        still=None if still is None else _embed(still),
        trees=[_tree_row(tree) for tree in fruit_count.trees],
        histogram=drawing(histogram(sizes), axis=axis) if fruit_count.fruits else None,
        heads=fruit_heads(metres_per_unit),
        rows=[_row(fruit, metres_per_unit) for fruit in fruit_count.fruits],
        strips=[{"name": strip.stem, "source": _strip(strip)} for strip in strips],
        made=list(_flat(given)),
        version=versions()["fruitlangs"],
    )
    write_text(path, text)


def _template() -> Any:
    """The template of the page; every value in it is escaped."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template("page.html")


def _zero(fruit_count: FruitCount, provenance: Mapping[str, Any], metres_per_unit: float | None) -> str:
    """Why there is no fruit: from the settings, else from the largest clusters of the audit."""
    if any(entry.fruit_ids for entry in fruit_count.audit):
        return "every counted fruit was rejected"
    threshold = provenance.get("config", {}).get("count", {}).get("threshold")
    if threshold is None:
        largest = sorted(fruit_count.audit, key=lambda entry: -entry.points)[:REASONS]
        return "; ".join(audit_reason(entry, metres_per_unit) for entry in largest) or "no fruit was found"
    return explain_nothing_found(fruit_count, threshold, metres_per_unit)


def _tree_row(tree: Tree) -> dict[str, Any]:
    return {
        "number": tree.number,
        "count": tree.count,
        "interval": _span(tree.interval),
        "total": _span(tree.total_interval),
    }


def _span(interval: tuple[int, int] | None) -> str:
    return "-" if interval is None else f"{interval[0]}–{interval[1]}"


def _row(fruit: Fruit, metres_per_unit: float | None) -> dict[str, Any]:
    color = "#{:02x}{:02x}{:02x}".format(*id_color(fruit.id))
    cells = fruit_cells(fruit, metres_per_unit)
    return {"id": fruit.id, "label": fruit.label, "kind": KIND_TEXTS[fruit.kind], "color": color, "cells": cells}


def _embed(picture: Image.Image) -> str:
    """Return the picture as a data URL."""
    return "data:image/jpeg;base64," + base64.b64encode(jpeg(picture)).decode("ascii")


def _strip(path: Path) -> str:
    try:
        with Image.open(io.BytesIO(path.read_bytes())) as opened:
            picture = opened.convert("RGB")
    except OSError as error:
        raise OutputError(f"The picture {path} cannot be read ({error}). Leave it out or count again") from error
    if picture.width > _STRIP_WIDTH:
        picture = picture.resize((_STRIP_WIDTH, round(picture.height * _STRIP_WIDTH / picture.width)))
    return _embed(picture)


def _flat(given: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, str]]:
    """Nested values as lines of name.name and text, in the given order."""
    for name, value in given.items():
        full = f"{before}{name}"
        if isinstance(value, Mapping):
            yield from _flat(value, f"{full}.")
        elif isinstance(value, Sequence) and not isinstance(value, str):
            parts = [" ".join(map(" ".join, _flat(part))) if isinstance(part, Mapping) else str(part) for part in value]
            yield full, ", ".join(parts) or "-"
        else:
            yield full, "-" if value is None else str(value)
