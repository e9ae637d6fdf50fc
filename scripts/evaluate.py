"""Measure counted fruit against the truth of a generated orchard.

    python scripts/evaluate.py RESULT_DIR… --truth truth.json

Prints one row a result folder and matching radius (in mean true diameters). F1 is against visible fruit of the
counted kinds; a prediction on another true fruit of them is ignored.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import _checkout  # noqa: F401  puts the checkout on the path

import numpy as np

from fruitlangs.engine.errors import FruitLangsError, VocabularyError
from fruitlangs.engine.evaluation.metrics import CountMetrics, count_metrics
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.engine.language.vocabulary import parse
from fruitlangs.engine.report.results import read_results

RADII = (0.5, 1.0)
HEADER = (
    "result", "radius", "predicted", "visible", "matched", "ignored", "precision", "recall", "F1", "doubles", "merges",
    "count error", "centre error", "diameter error", "diameter bias",
)  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Print the table; 0 when every folder could be measured, else 1."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="+", type=Path, metavar="RESULT_DIR", help="folder with a fruits.json")
    parser.add_argument("--truth", type=Path, required=True, help="truth.json of the scene that was counted")
    parser.add_argument("--label", help="measure against true fruit of this word only (default: the counted prompts)")
    arguments = parser.parse_args(argv)
    try:
        rows = [row for folder in arguments.results for row in measure(folder, arguments.truth, arguments.label)]
    except FruitLangsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(table([HEADER, *rows]))
    return 0


def measure(folder: Path, truth_file: Path, label: str | None) -> list[tuple[str, ...]]:
    """One row of cells a matching radius for a result folder."""
    document = read_results(folder, verify=False)
    fruits = document["fruits"]
    truth = read_truth(truth_file, labels([label] if label else document["provenance"]["prompts"]))
    unit = document["metres_per_unit"] or 1.0
    centers = np.array([fruit["center"] for fruit in fruits], dtype=np.float64).reshape(-1, 3)
    diameters = np.array([fruit["diameter"] / unit for fruit in fruits], dtype=np.float64)
    return [cells(folder.name, count_metrics(centers, diameters, truth, radius)) for radius in RADII]


def labels(prompts: Sequence[str]) -> set[str]:
    """Labels of true fruit that satisfy any of the prompts, whatever their colour: "red apple" counts apples.

    Raises:
        VocabularyError: a prompt names no thing.
    """
    phrases = [parse(prompt) for prompt in prompts]
    for phrase in phrases:
        if not phrase.concepts:
            raise VocabularyError(f"the prompt '{phrase.text}' names no fruit to measure against; give --label")
    return {concept for phrase in phrases for concept in phrase.concepts}


def cells(name: str, metrics: CountMetrics) -> tuple[str, ...]:
    """A table row of one measurement."""
    counts = (metrics.predicted, metrics.visible, metrics.matched, metrics.ignored)
    ratios = (metrics.precision, metrics.recall, metrics.f1)
    return (
        name,
        f"{metrics.radius:g}",
        *(str(count) for count in counts),
        *(f"{ratio:.3f}" for ratio in ratios),
        str(metrics.doubles),
        str(metrics.merges),
        f"{metrics.count_error:+d} ({metrics.relative_count_error:+.1%})",
        f"{metrics.center_error:.3f}",
        f"{metrics.diameter_error:.1%}",
        f"{metrics.diameter_bias:+.1%}",
    )


def table(rows: list[tuple[str, ...]]) -> str:
    """Rows of cells in aligned columns."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    first, *others = widths
    return "\n".join(
        "  ".join([row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others, strict=True))])
        for row in rows
    )


if __name__ == "__main__":
    sys.exit(main())
