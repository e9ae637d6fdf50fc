"""Tables in documents, between marks, filled from the records.

A document holds `<!-- table NAME -->` and, after the table, `<!-- end -->`; NAME is one of `tables.TABLES`. What lies
between is replaced.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ...engine.storage.files import write_text
from ..plots import save_plot
from .code_state import ROOT
from .records import Record
from .studies import STUDIES, select_study
from .tables import STUDY_OF, TABLES, condition_results, head, summary_line

FOR_USERS = ("docs/accuracy.md",)
DOCUMENTS = (*FOR_USERS, "benchmarks/RESULTS.md")
CONDITIONS_PICTURE = ROOT / "docs" / "images" / "conditions.png"
_BLOCK = re.compile(r"(<!-- table ([a-z-]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def fill(text: str, records: Sequence[Record], *, for_users: bool = False) -> str:
    """Return a document with every table as the records have it; for users without commits and machines."""

    def block(found: re.Match[str]) -> str:
        name = found[2]
        study = STUDY_OF.get(name)
        parts = [head(study, records, for_users=for_users)] if study else []
        if not study or select_study(study, records):
            parts.append(TABLES[name](records))
        if name in STUDIES:
            parts.append(summary_line(name, records))
        return found[1] + "\n\n".join(filter(None, parts)) + "\n" + found[3]

    return _BLOCK.sub(block, text)


def write_documents(records: Sequence[Record]) -> None:
    """Fill the tables of all documents, and draw the picture of the conditions if any was measured."""
    for name in DOCUMENTS:
        path = ROOT / name
        write_text(path, fill(path.read_text(encoding="utf-8"), records, for_users=name in FOR_USERS))
    own = condition_results(select_study("conditions", records))
    if len(own) > 1:
        draw_conditions([(words, result.near.f1 if result.near else 0.0) for words, result in own], CONDITIONS_PICTURE)


def draw_conditions(scores: Sequence[tuple[str, float]], path: Path) -> None:
    """Bars of F1 by condition, the worst at the bottom. scores: the usual condition first."""
    from matplotlib.figure import Figure

    usual = scores[0][1]
    ordered = sorted(scores, key=lambda each: each[1])
    figure = Figure(figsize=(8.0, 0.32 * len(ordered) + 1.0), layout="constrained")
    axes = figure.add_subplot()
    colours = ["#b2403a" if f1 < usual - 0.1 else "#d9a441" if f1 < usual - 0.03 else "#4c8c4a" for _, f1 in ordered]
    axes.barh([words for words, _ in ordered], [f1 for _, f1 in ordered], color=colours)
    axes.axvline(usual, color="#222222", linewidth=1.0, linestyle="--")
    for place, (_, f1) in enumerate(ordered):
        axes.text(f1 - 0.01, place, f"{f1:.2f}", ha="right", va="center", color="white", fontsize=8)
    axes.set_xlim(0.0, 1.0)
    axes.set_xlabel("F1 score (1: every visible fruit found once, nothing false); dashed: the usual tree")
    save_plot(figure, path)
