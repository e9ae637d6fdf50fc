"""Names of fruit, lengths and reasons of a zero as texts: the same in files, the terminal and Blender."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..counting.fruit import AuditEntry, Fruit, FruitCount, Tree


def object_name(fruit: Fruit) -> str:
    """Name of the object of a fruit in every format, for example `apple.001` or `red apple.001`."""
    return fruit_name(fruit.label, fruit.id)


def fruit_name(label: str, number: int) -> str:
    """Name of the object of a fruit of that label and id."""
    return f"{label}.{number:03d}"


def place(entry: AuditEntry) -> tuple[float, float, float] | None:
    """Centre of an audited cluster; None for an entry about many or none, whose centre is (0, 0, 0)."""
    return entry.center if any(entry.center) else None


def audit_reason(entry: AuditEntry, metres_per_unit: float | None) -> str:
    """The reason for a cluster's verdict, with the size of its fruit: 'one sphere, …; diameter 78.3 mm'."""
    if entry.diameter is None:
        return entry.reason
    unit, scale = length_unit(metres_per_unit)
    mean = "mean " if len(entry.fruit_ids) > 1 else ""
    return f"{entry.reason}; {mean}diameter {format_three_digits(scale * entry.diameter)} {unit}"


def count_text(fruit_count: FruitCount) -> str:
    """The count with its intervals: '114 visible fruit (90 % interval 105–122). About 121 with hidden fruit (108–140)'.

    If the most likely number differs from the count, it is given too; if it is larger and the interval starts at the
    count, so is the reason.
    """
    count = f"{fruit_count.count} visible fruit"
    if fruit_count.interval is None:
        return count
    text = f"{count} ({_interval(fruit_count.interval)})"
    likely = None if fruit_count.likely is None else round(fruit_count.likely)
    if likely not in (None, fruit_count.count):
        text = f"{count} counted, most likely {likely} ({_interval(fruit_count.interval)})"
    if fruit_count.total is not None and fruit_count.total_interval is not None:
        low, high = fruit_count.total_interval
        text += f". About {fruit_count.total:.0f} with hidden fruit ({low}–{high})"
    if likely is not None and likely > fruit_count.count == fruit_count.interval[0]:
        text += ". The interval starts at the count because missed fruit are more likely than false ones"
    return text


def headline(counted: FruitCount | Tree, what: str) -> str:
    """A count as a title: 'apple: 123 (90 % interval 115–133)'."""
    text = f"{what}: {counted.count}"
    return text if counted.interval is None else f"{text} ({_interval(counted.interval)})"


def _interval(interval: tuple[int, int]) -> str:
    return f"90 % interval {interval[0]}–{interval[1]}"


def location_text(fruit_count: FruitCount) -> list[str]:
    """Locations of the counted fruit, one sentence each: hanging or on the ground, and on which tree of the row."""
    hanging, fallen = fruit_count.hanging, fruit_count.fallen
    if hanging is None or fallen is None:
        lines = ["hanging or fallen: unknown, because no ground was found"]
    else:
        unknown = fruit_count.count - hanging - fallen
        lines = [f"{hanging} hanging, {fallen} on the ground" + (f", {unknown} unknown" if unknown else "")]
    if fruit_count.trees:
        counts = ", ".join(f"{tree.count} on tree {tree.number}{_tree_interval(tree)}" for tree in fruit_count.trees)
        elsewhere = sum(fruit.tree is None for fruit in fruit_count.fruits)
        lines.append(counts + (f", {elsewhere} on none of them" if elsewhere else ""))
    return lines


def _tree_interval(tree: Tree) -> str:
    if tree.interval is None:
        return ""
    hidden = "" if tree.total_interval is None else ", with hidden fruit {}–{}".format(*tree.total_interval)
    return f" ({_interval(tree.interval)}{hidden})"


def explain_nothing_found(fruit_count: FruitCount, threshold: float, metres_per_unit: float | None) -> str:
    """Say why there is no fruit: those that were found are of other kinds or colours, nothing reached `threshold`, or
    what reached it does not have the shape of a fruit."""
    if fruit_count.other_fruit:
        return f"the {fruit_count.other_fruit} fruit that were found look like other kinds"
    if fruit_count.other_colors:
        return f"the {fruit_count.other_colors} fruit that were found have other colours"
    highest = fruit_count.max_probability
    if highest < threshold:
        return f"nothing reached the threshold {threshold:.2f}; the highest probability is {highest:.2f}"
    clusters = sum(place(entry) is not None for entry in fruit_count.audit)
    if clusters == 1:
        return f"1 cluster reached the threshold {threshold:.2f}, but it does not have the shape of a fruit"
    if clusters:
        return f"{clusters} clusters reached the threshold {threshold:.2f}, but none has the shape of a fruit"
    return "; ".join(audit_reason(entry, metres_per_unit) for entry in fruit_count.audit)


def length_unit(metres_per_unit: float | None) -> tuple[str, float]:
    """The unit of lengths for people, and how many of it a scene unit is: mm if the scale is known."""
    return ("scene units", 1.0) if metres_per_unit is None else ("mm", 1000.0 * metres_per_unit)


def file_unit(metres_per_unit: float | None) -> tuple[str, float]:
    """The unit of lengths in files for programs, and how many of it a scene unit is: m if the scale is known."""
    return ("scene units", 1.0) if metres_per_unit is None else ("m", metres_per_unit)


def training_text(training: Mapping[str, Any]) -> str:
    """Say what trained the Gaussians, to end a sentence: ", trained on CPU"; empty in results of earlier versions."""
    return f", trained on {training['device']}" if "device" in training else ""


def format_three_digits(value: float) -> str:
    """Format a measured number with three significant digits: 78.3, 0.0783, 1230."""
    return f"{float(f'{value:.3g}'):g}"


def scale_text(scale: Mapping[str, Any]) -> str:
    """The provenance's scale as text: '1 scene unit is 0.998 m ± 0.4 %, by the GPS tags of 60 photos'."""
    metres, error = scale["metres_per_unit"], scale["standard_error"]
    spread = "" if error is None else f" ± {error / metres:.1%}".replace("%", " %")
    return f"1 scene unit is {format_three_digits(metres)} m{spread}, by {scale['of']}"
