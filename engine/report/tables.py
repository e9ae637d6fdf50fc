"""Counts as tables: CSV for programs, text for a terminal."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence

import numpy as np

from ..counting.fruit import KIND_TEXTS, Fruit, FruitCount
from .words import (
    audit_reason,
    count_text,
    explain_nothing_found,
    format_three_digits,
    length_unit,
    location_text,
    place,
)


def fruits_csv(fruit_count: FruitCount, *, metres_per_unit: float | None) -> str:
    """One row per fruit; the unit of every length is in the name of its column: mm and cm³ if the scale is known."""
    unit, volume_unit = ("units", "units3") if metres_per_unit is None else ("mm", "cm3")
    _, scale = length_unit(metres_per_unit)
    decimals = 6 if metres_per_unit is None else 2
    volume_scale = _volume_scale(metres_per_unit)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["id", "label", "x_units", "y_units", "z_units", f"diameter_{unit}", f"diameter_sd_{unit}"]
        + [f"length_{unit}", f"width_{unit}", f"thickness_{unit}"]
        + [f"volume_{volume_unit}", "probability", "visible_fraction", "views", "red", "green", "blue", "kind"]
        + ["fallen", "tree"]
    )
    for fruit in fruit_count.fruits:
        visible = "" if fruit.visible_fraction is None else f"{fruit.visible_fraction:.4f}"
        writer.writerow(
            [fruit.id, fruit.label, *(f"{value:.6f}" for value in fruit.center)]
            + [_number(value * scale, decimals) for value in (fruit.diameter, fruit.diameter_sd, *fruit.lengths)]
            + [f"{fruit.volume * volume_scale:.6g}"]
            + [f"{fruit.probability:.4f}", visible, fruit.views, *fruit.color.tolist(), fruit.kind]
            + ["" if fruit.fallen is None else str(fruit.fallen).lower(), "" if fruit.tree is None else fruit.tree]
        )
    return text.getvalue()


def _number(value: float, decimals: int) -> str:
    """Empty if unknown (NaN), such as the deviation of a diameter that the user set."""
    return "" if math.isnan(value) else f"{value:.{decimals}f}"


def summary(
    fruit_count: FruitCount,
    *,
    prompt: str,
    threshold: float,
    metres_per_unit: float | None,
    seconds: Mapping[str, float],
    rows: int = 10,
) -> str:
    """The table printed at the end of a run: the count, its sizes, its first fruit, and seconds by stage.

    threshold: of the probability, which explains a count of 0.
    """
    lines = [f"{prompt}: {count_text(fruit_count)}"]
    if fruit_count.fruits:
        lines += [f"  {where}" for where in location_text(fruit_count)]
        unknown = " (scale unknown: --units.length sets it)" if metres_per_unit is None else ""
        mean, *others = size_lines(fruit_count, metres_per_unit)
        lines += [f"  {mean}{unknown}", *(f"  {other}" for other in others)]
        lines += ["", *_fruit_rows(fruit_count.fruits[:rows], metres_per_unit)]
        if fruit_count.count > rows:
            lines.append(f"  … {fruit_count.count - rows} more in fruits.csv")
    else:
        lines.append(f"  {explain_nothing_found(fruit_count, threshold, metres_per_unit)}")
        clusters = [entry for entry in fruit_count.audit if place(entry) is not None]
        lines += [f"  {entry.verdict}: {audit_reason(entry, metres_per_unit)}" for entry in clusters[:rows]]
    lines += ["", "  " + "  ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items())]
    return "\n".join(lines)


def size_lines(fruit_count: FruitCount, metres_per_unit: float | None) -> list[str]:
    """Sentences about at least one fruit: sizes, kinds and, if it is known, the width in the photos."""
    unit, scale = length_unit(metres_per_unit)
    mean = format_three_digits(scale * float(fruit_count.diameters.mean()))
    low, high = (format_three_digits(scale * float(value)) for value in np.quantile(fruit_count.diameters, [0.1, 0.9]))
    fruits = fruit_count.fruits
    kinds = ", ".join(f"{sum(fruit.kind == kind for fruit in fruits)} {KIND_TEXTS[kind]}" for kind in _kinds(fruits))
    lines = [f"mean diameter {mean} {unit}, 80 % between {low} and {high}", f"kinds: {kinds}"]
    if fruit_count.pixel_width is not None:
        lines.append(f"median width in the photos as read: {fruit_count.pixel_width:.0f} pixels")
    return lines


def fruit_heads(metres_per_unit: float | None) -> list[str]:
    """The headings of `fruit_cells`, with units."""
    unit, volume_unit = length_unit(metres_per_unit)[0], "cubed scene units" if metres_per_unit is None else "cm³"
    return [f"diameter ({unit})", f"volume ({volume_unit})", "probability", "visible"]


def fruit_cells(fruit: Fruit, metres_per_unit: float | None) -> list[str]:
    """Diameter of a fruit (± its deviation if known), volume, probability and visible share as texts."""
    _, scale = length_unit(metres_per_unit)
    volume = fruit.volume * _volume_scale(metres_per_unit)
    size = format_three_digits(fruit.diameter * scale)
    if not math.isnan(fruit.diameter_sd):
        size += f" ± {float(f'{fruit.diameter_sd * scale:.2g}'):g}"
    return [size, format_three_digits(volume), f"{fruit.probability:.2f}", _visible(fruit)]


def _visible(fruit: Fruit) -> str:
    return "-" if fruit.visible_fraction is None else f"{100 * fruit.visible_fraction:.0f} %"


def _volume_scale(metres_per_unit: float | None) -> float:
    """cm³ per cubed scene unit; 1 if the scale is unknown."""
    return 1.0 if metres_per_unit is None else (100.0 * metres_per_unit) ** 3


def _kinds(fruits: Sequence[Fruit]) -> list[str]:
    return sorted({fruit.kind for fruit in fruits})


def _fruit_rows(fruits: Sequence[Fruit], metres_per_unit: float | None) -> list[str]:
    unit, scale = length_unit(metres_per_unit)
    size_head = f"diameter/{unit.removeprefix('scene ')}"
    header = f"  {'id':>4}  {'label':<12} {size_head:>14} {'probability':>12} {'visible':>8}  kind"
    rows = []
    for fruit in fruits:
        size = format_three_digits(fruit.diameter * scale)
        certainty = f"{fruit.probability:>12.2f} {_visible(fruit):>8}"
        rows.append(f"  {fruit.id:>4}  {fruit.label:<12} {size:>14} {certainty}  {KIND_TEXTS[fruit.kind]}")
    return [header, *rows]
