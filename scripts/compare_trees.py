"""Compare counted with true fruit tree by tree along a row.

    python scripts/compare_trees.py RESULT_DIR --truth truth.json

The truth says for each fruit on which tree it hangs. A counted fruit belongs to the tree that the result itself gives
it (--count.trees); where it gives none, or with --trees, to the nearest tree along the row, or to the box it lies in
where --trees gives boxes. Prints a row a tree, then mean absolute percentage error, bias and R²: against visible fruit
and against all.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np
from numpy.typing import NDArray

from _terminal import arguments_of, format_table, program, run
from fruitlangs.engine.counting.fruit import NO_TREE
from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.evaluation.trees import (
    TreeComparison,
    TreePlaces,
    assign_to_trees,
    compare,
    places_of,
    read_places,
    tally,
)
from fruitlangs.engine.evaluation.truth import read_truth, true_labels
from fruitlangs.engine.result_folder import ResultFolder
from fruitlangs.engine.scene.formats.cameras_json import read_cameras
from fruitlangs.engine.training import CAMERAS

RADIUS = 0.5
"""Largest distance of a counted from a true fruit, in diameters."""


def main(given: Sequence[str] | None = None) -> None:
    """Print the table.

    Raises:
        FruitLangsError: the result cannot be compared.
    """
    parser = argparse.ArgumentParser(
        prog=program(__file__), description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("result", type=Path, metavar="RESULT_DIR", help="folder with a fruits.json")
    parser.add_argument("--truth", type=Path, required=True, help="truth.json of the row that was counted")
    parser.add_argument("--trees", type=Path, help="text: number x y z a tree, or number and two corners of its box")
    parser.add_argument("--label", help="compare with true fruit of this word only (default: the counted prompts)")
    arguments = parser.parse_args(arguments_of(__file__) if given is None else given)
    print(comparison_table(*compare_row(arguments.result, arguments.truth, arguments.trees, arguments.label)))


def compare_row(
    folder: Path, truth_file: Path, trees_file: Path | None, label: str | None
) -> tuple[TreeComparison, TreeComparison, list[float]]:
    """The counted fruit of a result folder compared with visible fruit and with all fruit, by tree; and F1 of each
    tree: a fruit that was counted for a wrong tree is missing there and too many here."""
    document = ResultFolder(folder).read(verify=False)
    up = read_cameras(folder / CAMERAS).up
    wanted = true_labels([label] if label else document["provenance"]["prompts"])
    truth = read_truth(truth_file, wanted)
    numbers = truth.trees
    if numbers is None or not numbers.any():
        raise FormatError(f"{truth_file}: none of its fruit says which tree it hangs on. Expected a number as its tree")
    centers = _stack(fruit["center"] for fruit in document["fruits"])
    places = places_of(truth.centers, numbers) if trees_file is None else read_places(trees_file)
    if trees_file is None and document.get("trees"):
        counted = find_own_trees(document, places, up)
    else:
        counted = assign_to_trees(centers, places, up)
    trees = np.union1d(places.numbers, numbers[numbers != NO_TREE])
    diameters = np.array([fruit["diameter"] for fruit in document["fruits"]], np.float64)
    diameters /= document["metres_per_unit"] or 1.0
    scores = [
        count_metrics(centers[counted == tree], diameters[counted == tree], truth.select(numbers == tree), RADIUS).f1
        for tree in trees
    ]
    visible, total = (compare(tally(of, trees), counted) for of in (numbers[truth.visible], numbers))
    return visible, total, scores


def find_own_trees(document: Mapping[str, Any], places: TreePlaces, up: NDArray[np.float64]) -> NDArray[np.int64]:
    """Find the true number (P,) of the tree of each fruit: that of the true tree at the position of the result's
    tree."""
    stand = assign_to_trees(_stack(tree["position"] for tree in document["trees"]), places, up)
    numbers = {tree["number"]: int(true) for tree, true in zip(document["trees"], stand, strict=True)}
    return np.array([numbers.get(fruit["tree"], NO_TREE) for fruit in document["fruits"]], dtype=np.int64)


def _stack(places: Iterable[Sequence[float]]) -> NDArray[np.float64]:
    return np.array(list(places), dtype=np.float64).reshape(-1, 3)


def comparison_table(visible: TreeComparison, total: TreeComparison, scores: Sequence[float]) -> str:
    """One row per tree, the sum, and one line of figures for each of the two truths. scores: F1 of each tree."""
    columns = (visible.trees, visible.true, total.true, visible.counted, scores)
    rows = [
        (str(tree), str(seen), str(every), str(counted), f"{counted - seen:+d}", f"{score:.3f}")
        for tree, seen, every, counted, score in zip(*columns, strict=True)
    ]
    sums = [int(column.sum()) for column in (visible.true, total.true, visible.counted)]
    whole = ("sum", *(str(value) for value in sums), f"{sums[2] - sums[0]:+d}", "")
    lines = [format_table([("tree", "visible", "true", "counted", "counted - visible", "F1"), *rows, whole])]
    for name, comparison in (("visible fruit", visible), ("all fruit", total)):
        lines.append(
            f"against {name}: MAPE {comparison.mape:.1%}, bias {comparison.bias:+.2f} a tree, R² {comparison.r2:.3f}"
        )
    if visible.elsewhere:
        lines.append(f"{visible.elsewhere} counted fruit belong to no tree of the row")
    return "\n".join(lines)


if __name__ == "__main__":
    run(main)
