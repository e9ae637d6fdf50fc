"""What scenes with known fruit show about their counts: the examples that intervals are fitted to, kept in a table so
that a coverage can be computed again without rendering."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...engine.counting.accounts.interval import COVARIATES, Evidence
from ...engine.errors import FormatError
from ...engine.storage.files import write_text

STORED_EXAMPLES = Path(__file__).with_name("interval_examples.csv")
COLUMNS = ("kind", "family", "expected", "variance", *COVARIATES, "photos", "dissent", "visible", "total")


@dataclass(frozen=True, eq=False)
class Example:
    """One scene. kind: of scene; family: all examples of one tree or crown; visible: true fruit that views show, and
    others that were found; total: all true fruit."""

    kind: str
    family: str
    evidence: Evidence
    visible: int
    total: int


def merge_examples(earlier: Iterable[Example], later: Iterable[Example]) -> list[Example]:
    """Return all examples; a later one of the same kind and family replaces the earlier one."""
    return list({(example.kind, example.family): example for example in (*earlier, *later)}.values())


def write_examples(examples: Sequence[Example], path: Path = STORED_EXAMPLES) -> None:
    """Write the table, sorted by kind and family."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for example in sorted(examples, key=lambda each: (each.kind, each.family)):
        evidence = example.evidence
        numbers = (evidence.expected, evidence.variance, *evidence.covariates)
        cells = (example.kind, example.family, *(f"{number:.8g}" for number in numbers))
        writer.writerow((*cells, int(evidence.photos), f"{evidence.dissent:.8g}", example.visible, example.total))
    write_text(path, text.getvalue())


def read_examples(path: Path = STORED_EXAMPLES) -> list[Example]:
    """The examples of a table; none if there is no file.

    Raises:
        FormatError: a column is missing, or a cell is not a number.
    """
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        try:
            return [_parse_example(cells) for cells in csv.DictReader(file)]
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(f"{path} is damaged ({error}). Restore it from the repository") from error


def _parse_example(cells: dict[str, str]) -> Example:
    covariates = np.array([float(cells[name]) for name in COVARIATES])
    evidence = Evidence(
        expected=float(cells["expected"]),
        variance=float(cells["variance"]),
        covariates=covariates,
        photos=bool(int(cells["photos"])),
        dissent=float(cells["dissent"]),
    )
    return Example(cells["kind"], cells["family"], evidence, int(cells["visible"]), int(cells["total"]))
