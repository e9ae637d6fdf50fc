"""The answer for a block as files: a line for each tree, sums for rows and the block, and places for maps."""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..errors import ConfigError, VocabularyError
from ..language.colours import fruit_colours
from ..language.vocabulary import FRUIT_COLOURS, parse, split
from ..storage.files import write_text
from .ledger import TREES
from .totals import SHARED_ALL, SHARED_VISIBLE, Amount, estimate_all, sum_amounts
from .trees import CountedTree

COLUMNS = (
    "tree", "row", "position", "prompt", "latitude", "longitude", "state", "count", "reviewed", "likely", "low",
    "high", "with_hidden", "with_hidden_low", "with_hidden_high", "mean_diameter", "diameter_sd", "unit", "volume",
    "fruit_weight_g", "yield_kg", "reason",
)  # fmt: skip
ORCHARD_JSON, PLACES = "orchard.json", "orchard.geojson"
DECIMALS = 6
CLASS_MM = 5
"""Width of a size class."""
NO_FRUIT = Amount(count=0, likely=0.0, low=0.0, high=0.0)
NO_SIZES = "Sizes are not summed up, because the scale of some trees is unknown"


def rows_of(trees: Sequence[CountedTree], density: float | None) -> list[dict[str, Any]]:
    """A row for each tree, by column. density: kg per m³ of the fruit, None if not given; weights need metres."""
    rows = []
    for tree in trees:
        row: dict[str, Any] = dict.fromkeys(COLUMNS)
        entry = tree.entry
        row |= {"tree": entry.id, "row": entry.row, "position": entry.position, "prompt": _prompt(tree)}
        row |= {"latitude": entry.latitude, "longitude": entry.longitude}
        row |= {"state": "outdated" if tree.outdated else tree.state.stage, "reason": tree.note or tree.state.reason}
        if tree.count is not None:
            row |= {"count": tree.counted, "reviewed": tree.reviewed}
            row |= {**_ends(tree.visible, ""), **_ends(tree.total, "with_hidden")}
            row |= {"unit": "m" if tree.metric else "scene units", "volume": float(f"{tree.volume:.6g}")}
            if tree.diameters:
                row["mean_diameter"] = round(float(np.mean(tree.diameters)), DECIMALS)
                row["diameter_sd"] = round(float(np.std(tree.diameters)), DECIMALS)
            if density is not None and tree.metric:
                row["yield_kg"] = round(density * tree.volume, 3)
                fruit = max(len(tree.diameters), 1)
                row["fruit_weight_g"] = round(1000.0 * density * tree.volume / fruit, 1) if tree.volume else None
        rows.append(row)
    return rows


def _ends(amount: Amount | None, name: str) -> dict[str, float | None]:
    """The most likely number and the interval, by column; None where they are unknown."""
    low, high, likely = ("low", "high", "likely") if not name else (f"{name}_low", f"{name}_high", name)
    if amount is None:
        return dict.fromkeys((likely, low, high))
    return {likely: round(amount.likely, 1), low: round(amount.low, 1), high: round(amount.high, 1)}


def summary(trees: Sequence[CountedTree], *, all_trees: int | None, density: float | None) -> dict[str, Any]:
    """The block in numbers: states, what failed, and sums by row and in all, sizes, colours and weight; if the trees
    have several prompts, these also for each prompt.

    all_trees: of the block, of which these are a random sample; None if these are all. `notes` says what to know about
    counts, by result. A sum has no interval if `without_interval` of its trees have none. Sizes are None with a reason
    in `no_diameters` if results have different units, and the estimate for all trees with one in `no_estimate` if too
    few trees are done, or some have no interval.
    """
    done = [tree for tree in trees if tree.count is not None]
    document: dict[str, Any] = {
        "trees": len(trees),
        "done": len(done),
        "failed": {tree.entry.id: tree.state.reason for tree in trees if tree.state.stage == "failed"},
        "notes": {tree.folder or tree.entry.id: tree.note for tree in done if tree.note},
        "elsewhere": sum(tree.elsewhere for tree in done),
        "waiting": sum(tree.state.stage in ("waiting", "running") for tree in trees),
        "block": _sums(done),
        **_numbers(done, density),
        "density": density,
    }
    if len(set(map(_prompt, trees))) > 1:
        by_prompt = _group(_prompt, done)
        document["prompts"] = {each: {**_sums(own), **_numbers(own, density)} for each, own in by_prompt.items()}
    if all_trees is not None:
        document["all_trees"] = _estimate_all(done, all_trees)
        for prompt, numbers in document.get("prompts", {}).items():
            # A tree of another prompt was drawn, too, and bears none of this fruit.
            numbers["all_trees"] = _estimate_all(
                [tree if _prompt(tree) == prompt else replace(tree, counted=0, visible=NO_FRUIT) for tree in done],
                all_trees,
            )
    return document


def _numbers(done: Sequence[CountedTree], density: float | None) -> dict[str, Any]:
    """Sums by row, sizes, colours and weight of counted trees."""
    diameters = np.concatenate([np.zeros(0), *(tree.diameters for tree in done)])
    metric = bool(done) and all(tree.metric for tree in done)
    # Each result without a scale has a unit of its own.
    comparable = metric or len({(tree.folder, tree.metric) for tree in done}) == 1
    return {
        "rows": {row: _sums(own) for row, own in _group(lambda tree: tree.entry.row, done).items()},
        "unit": "m" if metric else "scene units",
        "diameters": _spread(diameters) if comparable else None,
        "no_diameters": "" if comparable or not len(diameters) else NO_SIZES,
        "size_classes_mm": _size_classes(diameters) if metric else None,
        "colours": _colours(done),
        "yield_kg": round(density * sum(tree.volume for tree in done), 3) if density is not None and metric else None,
    }


def _estimate_all(done: Sequence[CountedTree], all_trees: int) -> dict[str, Any]:
    """Return the estimate for all trees of the block from the counted ones, or why there is none."""
    amounts = [tree.visible for tree in done if tree.visible is not None]
    if len(amounts) < len(done):
        without = f"{len(done) - len(amounts)} of {len(done)} counted trees have no interval"
        return {"trees": all_trees, "no_estimate": without}
    try:
        return {"trees": all_trees, **_ends(estimate_all(amounts, list(map(_kind, done)), all_trees), "")}
    except ConfigError as error:
        return {"trees": all_trees, "no_estimate": str(error)}


def _kind(tree: CountedTree) -> str:
    """The kinds of fruit that are counted on a tree: the nouns of its prompts."""
    nouns = set()
    for prompt in tree.entry.prompt:
        try:
            nouns.add(parse(prompt).noun)
        except VocabularyError:  # a taught word, or one that only another encoder knows
            nouns.add(" ".join(split(prompt)))
    return " or ".join(sorted(nouns))


def _prompt(tree: CountedTree) -> str:
    """What is counted on a tree, in words."""
    return " or ".join(tree.entry.prompt)


def _group(name: Callable[[CountedTree], str], trees: Sequence[CountedTree]) -> dict[str, list[CountedTree]]:
    """Return {name: the trees with that name}; trees whose name is empty are left out."""
    found: dict[str, list[CountedTree]] = {}
    for tree in trees:
        if name(tree):
            found.setdefault(name(tree), []).append(tree)
    return found


def _sums(trees: Sequence[CountedTree]) -> dict[str, Any]:
    """Sums of counted trees. A sum has an interval only if each of its trees has one."""
    found: dict[str, Any] = {"trees": len(trees), "count": sum(tree.count or 0 for tree in trees)}
    found["without_interval"] = sum(tree.visible is None or tree.total is None for tree in trees)
    found |= _ends(_sum([tree.visible for tree in trees], trees, SHARED_VISIBLE), "")
    return found | _ends(_sum([tree.total for tree in trees], trees, SHARED_ALL), "with_hidden")


def _sum(amounts: Sequence[Amount | None], trees: Sequence[CountedTree], shared: float) -> Amount | None:
    """The sum of what is known of trees; None if it is unknown of one of them, or without trees."""
    known = [amount for amount in amounts if amount is not None]
    return sum_amounts(known, list(map(_kind, trees)), shared) if known and len(known) == len(trees) else None


def _colours(trees: Sequence[CountedTree]) -> dict[str, int]:
    """How many fruit have each colour, the commonest first: it indicates how ripe they are."""
    colors = [color for tree in trees for color in tree.colors]
    if not colors:
        return {}
    kinds = {prompt for tree in trees for prompt in tree.entry.prompt}
    said = fruit_colours(torch.tensor(colors, dtype=torch.float32) / 255.0, kinds).argmax(-1)
    return dict(Counter(FRUIT_COLOURS[each] for each in said.tolist()).most_common())


def _spread(diameters: np.ndarray) -> dict[str, Any] | None:
    """Mean, standard deviation and the ends of 80 %; None without fruit."""
    if not len(diameters):
        return None
    low, high = np.quantile(diameters, [0.1, 0.9])
    numbers = {"mean": diameters.mean(), "sd": diameters.std(), "low": low, "high": high}
    return {"fruit": len(diameters), **{name: round(float(value), DECIMALS) for name, value in numbers.items()}}


def _size_classes(diameters: np.ndarray) -> dict[str, int]:
    """How many fruit there are in each class of 5 mm, as fruit are sorted; diameters: metres."""
    classes, counts = np.unique(np.floor(1000.0 * diameters / CLASS_MM).astype(int), return_counts=True)
    return {
        f"{CLASS_MM * each}-{CLASS_MM * (each + 1)}": int(count) for each, count in zip(classes, counts, strict=True)
    }


def geojson(trees: Sequence[CountedTree], rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A point for each tree with a place (RFC 7946: longitude, then latitude)."""
    features = [
        {
            "type": "Feature",
            "geometry": {"type": "Point", "coordinates": [tree.entry.longitude, tree.entry.latitude]},
            "properties": {name: value for name, value in row.items() if name not in ("latitude", "longitude")},
        }
        for tree, row in zip(trees, rows, strict=True)
        if tree.entry.latitude is not None and tree.entry.longitude is not None
    ]
    return {"type": "FeatureCollection", "features": features}


def write_tables(
    folder: Path, trees: Sequence[CountedTree], rows: Sequence[dict[str, Any]], document: Mapping[str, Any]
) -> list[Path]:
    """Write orchard.csv, orchard.json and orchard.geojson into a block's folder; returns their paths. rows, document:
    from `rows_of` and `summary`.

    Raises:
        OutputError: the folder cannot be written.
    """
    text = io.StringIO()
    table = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    table.writeheader()
    table.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
    by_tree = [{**row, "result": f"{TREES}/{tree.folder}"} for row, tree in zip(rows, trees, strict=True)]
    contents = {
        "orchard.csv": text.getvalue(),
        ORCHARD_JSON: json.dumps({**document, "by_tree": by_tree}, indent=1) + "\n",
        PLACES: json.dumps(geojson(trees, rows), indent=1) + "\n",
    }
    for name, content in contents.items():
        write_text(folder / name, content)
    return [folder / name for name in contents]
