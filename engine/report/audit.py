"""`audit.txt`: for every cluster of points what became of it and why, for a person to read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from ..counting.fruit import AuditEntry, FruitCount
from .words import place, sureness

_ORDER = ("split", "kept", "merged", "dropped")
_MEANING = {
    "kept": "one fruit",
    "split": "several fruit that touch",
    "merged": "part of fruit of a cluster beside it",
    "dropped": "no fruit",
}


def audit_text(fruit_count: FruitCount, *, prompt: str) -> str:
    """The count with its intervals, then a line a cluster, by verdict and falling number of points.

    Places are in the scene's frame, in scene units.
    """
    verdicts = Counter[str](entry.verdict for entry in fruit_count.audit)
    lines = [f"{prompt}: {sureness(fruit_count)}", ""]
    lines += [f"{verdicts[name]:>6} clusters {name}: {_MEANING[name]}" for name in _ORDER if verdicts[name]]
    for name in _ORDER:
        entries = [entry for entry in fruit_count.audit if entry.verdict == name]
        if entries:
            lines += ["", f"{name.capitalize()} ({_MEANING[name]})", *_lines(entries)]
    return "\n".join(lines) + "\n"


def _lines(entries: Sequence[AuditEntry]) -> list[str]:
    lines = []
    for entry in sorted(entries, key=lambda entry: (-entry.points, entry.cluster)):
        at = place(entry)
        where = "" if at is None else " at " + " ".join(f"{value:.3f}" for value in at)
        fruit = f", fruit {', '.join(map(str, entry.fruit_ids))}" if entry.fruit_ids else ""
        lines.append(f"  {entry.points} points{where}{fruit}: {entry.reason}")
    return lines
