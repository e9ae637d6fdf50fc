"""Counts as tables: CSV for programs, text for a terminal."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence

import numpy as np

from ..counting.fruit import Fruit, FruitCount
from .words import nothing_found, place, whereabouts


def fruits_csv(fruit_count: FruitCount, *, metres_per_unit: float | None) -> str:
    """One row a fruit; the unit of every length stands in its column's name."""
    unit = "units" if metres_per_unit is None else "m"
    scale = 1.0 if metres_per_unit is None else metres_per_unit
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["id", "label", "x_units", "y_units", "z_units", f"diameter_{unit}", f"diameter_sd_{unit}", f"volume_{unit}3"]
        + ["probability", "visible_fraction", "views", "red", "green", "blue", "kind", "fallen", "tree"]
    )
    for fruit in fruit_count.fruits:
        visible = "" if fruit.visible_fraction is None else f"{fruit.visible_fraction:.4f}"
        writer.writerow(
            [fruit.id, fruit.label, *(f"{value:.6f}" for value in fruit.center)]
            + [f"{fruit.diameter * scale:.6f}", f"{fruit.diameter_sd * scale:.6f}", f"{fruit.volume * scale**3:.6g}"]
            + [f"{fruit.probability:.4f}", visible, fruit.views, *fruit.color.tolist(), fruit.kind]
            + ["" if fruit.fallen is None else str(fruit.fallen).lower(), "" if fruit.tree is None else fruit.tree]
        )
    return text.getvalue()


def summary(
    fruit_count: FruitCount,
    *,
    prompt: str,
    threshold: float,
    metres_per_unit: float | None,
    seconds: Mapping[str, float],
    rows: int = 10,
) -> str:
    """The table a person reads at the end of a run: the count, its sizes, its first fruit, and seconds by stage.

    threshold: the probability that was asked for, which explains a zero.
    """
    unit, scale = ("units", 1.0) if metres_per_unit is None else ("m", metres_per_unit)
    lines = [f"{prompt}: {fruit_count.count} visible fruit"]
    if fruit_count.fruits:
        lines += [f"  {where}" for where in whereabouts(fruit_count)]
        lines += _sizes(fruit_count.fruits, unit, scale)
        lines += ["", *_fruit_rows(fruit_count.fruits[:rows], unit, scale)]
        if fruit_count.count > rows:
            lines.append(f"  … {fruit_count.count - rows} more in fruits.csv")
    else:
        lines.append(f"  {nothing_found(fruit_count, threshold)}")
        clusters = [entry for entry in fruit_count.audit if place(entry) is not None]
        lines += [f"  {entry.verdict}: {entry.reason}" for entry in clusters[:rows]]
    lines += ["", "  " + "  ".join(f"{stage} {value:.1f} s" for stage, value in seconds.items())]
    return "\n".join(lines)


def _sizes(fruits: Sequence[Fruit], unit: str, scale: float) -> list[str]:
    diameters = np.array([fruit.diameter for fruit in fruits]) * scale
    low, middle, high = np.quantile(diameters, [0.1, 0.5, 0.9])
    kinds = ", ".join(f"{sum(fruit.kind == kind for fruit in fruits)} {kind}" for kind in _kinds(fruits))
    return [
        f"  diameter: median {middle:.4f} {unit}, 80 % between {low:.4f} and {high:.4f} {unit}",
        f"  kinds: {kinds}",
    ]


def _kinds(fruits: Sequence[Fruit]) -> list[str]:
    return sorted({fruit.kind for fruit in fruits})


def _fruit_rows(fruits: Sequence[Fruit], unit: str, scale: float) -> list[str]:
    header = f"  {'id':>4}  {'label':<12} {'diameter/' + unit:>14} {'probability':>12} {'visible':>8}  kind"
    rows = []
    for fruit in fruits:
        visible = "-" if fruit.visible_fraction is None else f"{100 * fruit.visible_fraction:.0f} %"
        size = f"{fruit.diameter * scale:.4f}"
        rows.append(
            f"  {fruit.id:>4}  {fruit.label:<12} {size:>14} {fruit.probability:>12.2f} {visible:>8}  {fruit.kind}"
        )
    return [header, *rows]
