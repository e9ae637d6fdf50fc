"""Tables in Markdown."""

from __future__ import annotations

from collections.abc import Sequence

NONE = "–"
"""Placeholder if there is nothing to measure."""


def markdown(lines: Sequence[Sequence[str]], *, named: bool = True) -> str:
    """A table of numbers, its first line the head. named: the first column contains words."""
    head, *body = lines
    rule = ["---" if named else "---:"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *body))
