"""Writes the answer for a block: from the results of its trees to tables and a page."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .geopackage import write_geopackage
from .ledger import Ledger
from .page import write_page
from .tables import ORCHARD_JSON, PLACES, rows_of, summary, write_tables
from .trees import CountedTree, read_counts


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The trees of a block, their sums (see `tables.summary`), and the written files."""

    trees: list[CountedTree]
    document: dict[str, Any]
    files: list[Path]


def publish_block(ledger: Ledger, *, all_trees: int | None = None, density: float | None = None) -> Answer:
    """Write the tables and the page of a block from what its results, and the reviews of these, say now.

    all_trees, density: as of `tables.summary`.

    Raises:
        OutputError, FormatError: the folder is not that of a block, or cannot be written.
    """
    trees = read_counts(ledger)
    rows = rows_of(trees, density)
    document = summary(trees, all_trees=all_trees, density=density)
    files = write_tables(ledger.path, trees, rows, document)
    files += write_geopackage(ledger.path / PLACES)
    files.append(write_page(ledger.path, trees, rows, document))
    return Answer(trees=trees, document=document, files=files)


def publish_again(ledger: Ledger) -> Answer:
    """The same with the number of all trees and the density that were given the last time.

    Raises:
        OutputError, FormatError: as `publish_block`.
    """
    all_trees, density = None, None
    with suppress(OSError, ValueError, TypeError, AttributeError):  # without a readable file, none was given
        document = json.loads((ledger.path / ORCHARD_JSON).read_text(encoding="utf-8"))
        all_trees, density = document.get("all_trees", {}).get("trees"), document.get("density")
    return publish_block(
        ledger,
        all_trees=all_trees if isinstance(all_trees, int) else None,
        density=float(density) if isinstance(density, int | float) and math.isfinite(density) else None,
    )
