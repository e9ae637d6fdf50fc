"""Measurements of generated scenes, each with the code, commit, date and machine: `benchmarks/results.csv`."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ...engine.errors import FormatError
from ...engine.storage.files import write_text
from ..ladder.ladder import StageResult
from ..ladder.rows import COLUMNS, cells_of, row_of, table_csv
from ..ladder.stages import COUNTING_ONLY, END_TO_END, TRUE_GEOMETRY
from ..two_photos import TWO_PHOTOS
from .code_state import code_hash, commit, day, machine

PROVENANCE = ("method", "code", "commit", "date", "machine")
RESULTS = Path(__file__).resolve().parents[1] / "results.csv"


@dataclass(frozen=True, kw_only=True, order=True)
class Trial:
    """What is measured. scene: a preset with a seed, such as apple-small-101; stage: of the ladder; method: of
    counting."""

    scene: str
    stage: str
    method: str = "voting"

    @property
    def code(self) -> str:
        """The hash of what it depends on, as it is now."""
        own = "benchmarks/two_photos.py" if self.method == TWO_PHOTOS else ""
        photo_search = self.method == "voting" and self.stage not in (COUNTING_ONLY, TRUE_GEOMETRY)
        return code_hash(self.scene.rpartition("-")[0], self.stage != END_TO_END, photo_search, own)


@dataclass(frozen=True, eq=False)
class Record:
    """A measured trial. cells: {column of results.csv: cell}."""

    cells: dict[str, str]

    @cached_property
    def result(self) -> StageResult:
        """What was measured."""
        return row_of(self.cells)

    @property
    def trial(self) -> Trial:
        """What it is a measurement of."""
        return Trial(scene=self.cells["scene"], stage=self.cells["ablation_stage"], method=self.cells["method"])

    @property
    def stale(self) -> bool:
        """Whether the code that it depends on has changed since."""
        return self.cells["code"] != self.trial.code


def record_of(result: StageResult, method: str) -> Record:
    """A result that was measured now, by this code on this computer."""
    record = Record({**cells_of(result), "method": method})
    record.cells.update(zip(PROVENANCE, (method, record.trial.code, commit(), day(), machine()), strict=True))
    return record


def read_records(path: Path = RESULTS) -> list[Record]:
    """The records of a file; none if there is no file.

    Raises:
        FormatError: a column is missing.
    """
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        missing = set(COLUMNS + PROVENANCE) - set(reader.fieldnames or ())
        if missing:
            raise FormatError(f"{path} lacks the columns {', '.join(sorted(missing))}. Restore it from the repository")
        return [Record(dict(cells)) for cells in reader]


def write_records(records: Sequence[Record], path: Path = RESULTS) -> None:
    """Write all records, sorted by what they measure."""
    ordered = sorted(records, key=lambda record: record.trial)
    write_text(path, table_csv([record.cells for record in ordered], COLUMNS + PROVENANCE))


def merge_records(earlier: Iterable[Record], later: Iterable[Record]) -> list[Record]:
    """Return all records; a later one of a trial replaces the earlier one."""
    return list({record.trial: record for record in (*earlier, *later)}.values())
