"""`audit.txt`: for every cluster of points what it became and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from ..counting.fruit import AuditEntry, FruitCount
from .words import audit_reason, count_text, length_unit, place

_ORDER = ("split", "kept", "merged", "dropped")
_MEANING = {
    "kept": "one fruit",
    "split": "several fruit that touch",
    "merged": "part of fruit of a neighbouring cluster",
    "dropped": "no fruit",
}


def audit_text(fruit_count: FruitCount, *, prompt: str, metres_per_unit: float | None) -> str:
    """The count with its intervals and units, then one line per cluster, by verdict and descending number of points."""
    verdicts = Counter[str](entry.verdict for entry in fruit_count.audit)
    unit, _ = length_unit(metres_per_unit)
    units = f"Places are x y z in the frame of the scene, in scene units; diameters are in {unit}."
    lines = [f"{prompt}: {count_text(fruit_count)}", units, ""]
    lines += [f"{verdicts[name]:>6} clusters {name}: {_MEANING[name]}" for name in _ORDER if verdicts[name]]
    for name in _ORDER:
        entries = [entry for entry in fruit_count.audit if entry.verdict == name]
        if entries:
            lines += ["", f"{name.capitalize()} ({_MEANING[name]})", *_lines(entries, metres_per_unit)]
    return "\n".join(lines) + "\n"


def _lines(entries: Sequence[AuditEntry], metres_per_unit: float | None) -> list[str]:
    lines = []
    for entry in sorted(entries, key=lambda entry: (-entry.points, entry.cluster)):
        at = place(entry)
        where = "" if at is None else " at " + " ".join(f"{value:.3f}" for value in at)
        fruit = f", fruit {', '.join(map(str, entry.fruit_ids))}" if entry.fruit_ids else ""
        lines.append(f"  {entry.points} points{where}{fruit}: {audit_reason(entry, metres_per_unit)}")
    return lines
