"""One crown or scene counted by one method, and a table of them that a second run continues."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...engine.errors import FormatError
from ...engine.evaluation.judgement import judge
from ...engine.evaluation.metrics import CountMetrics, VisibilityClass, measure, measure_by_visibility
from ...engine.evaluation.truth import Truth
from ...engine.storage.files import files_hash
from ...engine.storage.keys import stage_key
from .baselines import Found
from .touching import Touching, count_separated

EDGES = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Bounds of the classes of visible fraction."""
_HERE = Path(__file__).resolve().parent
_NAMES = ("setting", "seed", "method", "key")
_CLASS = ("visible", "recall", "center_error", "diameter_error")


@dataclass(frozen=True, kw_only=True)
class Trial:
    """setting: of a crown, or the species of a scene; key: of the code and the input; metrics: at half a diameter;
    classes: by visible fraction; touching: pairs that are visible to about 60 %."""

    setting: str
    seed: int
    method: str
    key: str
    metrics: CountMetrics
    classes: tuple[VisibilityClass, ...]
    touching: Touching


def measure_trial(setting: str, seed: int, method: str, key: str, found: Found, truth: Truth) -> Trial:
    """Measure the result of a method."""
    judgement = judge(*found, truth)
    return Trial(
        setting=setting,
        seed=seed,
        method=method,
        key=key,
        metrics=measure(judgement, truth),
        classes=tuple(measure_by_visibility(judgement, truth, EDGES)),
        touching=count_separated(found[0], truth),
    )


def code_key(given: object) -> str:
    """Key of `given` and of the code that simulates, counts and measures, without that of the pages."""
    own = [_HERE / f"{name}.py" for name in ("simulated", "baselines", "touching", "trials")]
    return stage_key(("scene", "splatting", "counting", "evaluation"), files_hash(own, _HERE), given)


def trials_csv(trials: Sequence[Trial]) -> str:
    """One line per trial, with unrounded figures."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*_NAMES, *_figures(), *_name_touching(), *(name for names in _classes() for name in names)])
    for trial in trials:
        writer.writerow(
            [getattr(trial, name) for name in _NAMES]
            + [getattr(trial.metrics, name) for name in _figures()]
            + [getattr(trial.touching, name) for name in _name_touching()]
            + [getattr(part, name) for part in trial.classes for name in _CLASS]
        )
    return text.getvalue()


def read_trials(path: Path) -> list[Trial]:
    """The trials of an earlier run; none without such a file.

    Raises:
        FormatError: the file is damaged.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return [_trial(row) for row in csv.DictReader(file)]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FormatError(f"{path} is damaged ({error}). Move it away; its crowns are counted again") from error


def _trial(row: Mapping[str, str]) -> Trial:
    classes = []
    for number, names in enumerate(_classes()):
        visible, *errors = (row[name] for name in names)
        parts = dict(zip(_CLASS[1:], map(float, errors), strict=True))
        classes.append(VisibilityClass(low=EDGES[number], high=EDGES[number + 1], visible=int(visible), **parts))
    return Trial(
        setting=row["setting"],
        seed=int(row["seed"]),
        method=row["method"],
        key=row["key"],
        metrics=metrics_of(row),
        classes=tuple(classes),
        touching=Touching(*(int(row[name]) for name in _name_touching())),
    )


def metrics_of(row: Mapping[str, str]) -> CountMetrics:
    """The figures in a line of a table that has a column for each."""
    figures: dict[str, Any] = {
        name: int(row[name]) if kind == "int" else float(row[name]) for name, kind in _figures().items()
    }
    return CountMetrics(**figures)


def _figures() -> Mapping[str, str]:
    """Names and types of all figures."""
    return CountMetrics.__annotations__


def _name_touching() -> Sequence[str]:
    return tuple(Touching.__dataclass_fields__)


def _classes() -> list[list[str]]:
    """Names of each class's columns."""
    return [[f"{name}_to_{high:g}" for name in _CLASS] for high in EDGES[1:]]
