"""What is declared of a single setting: its range, the kind of path it names, who needs it, and its text."""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import textwrap
from dataclasses import Field, dataclass, field
from typing import Any, Literal, get_args

Level = Literal["common", "advanced", "experimental"]
"""Who needs a setting: every user, users with a special case, or people who compare methods (the paper's ablation)."""
LEVELS: tuple[Level, ...] = get_args(Level)
PathKind = Literal["file", "folder"]
LARGEST = 2**31 - 1
"""The largest integer that every front end can hold."""


@dataclass(frozen=True)
class Range:
    """The numbers that a setting may have; `open` excludes both ends."""

    low: float
    high: float
    open: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low < value < self.high if self.open else self.low <= value <= self.high

    def __str__(self) -> str:
        if not self.open:
            return f"{self.low} to {self.high}"
        return f"a finite number above {self.low}" + ("" if math.isinf(self.high) else f" and below {self.high}")


def number(default: float | None, low: float, high: float, *, open: bool = False, level: Level = "advanced") -> Any:
    """A field whose value lies in a range, or is None if that is the default."""
    return field(default=default, metadata={"range": Range(low, high, open), "level": level})


def path(default: str, kind: PathKind, *, level: Level = "advanced") -> Any:
    """A field that names a file or a folder, or something else that a stage finds by name."""
    return field(default=default, metadata={"path": kind, "level": level})


def option(default: Any, *, level: Level) -> Any:
    """Any other field that is not advanced."""
    return field(default=default, metadata={"level": level})


def range_of(setting: Field[Any]) -> Range | None:
    """The range of a field; None if it is not a number."""
    return setting.metadata.get("range")


def path_kind(setting: Field[Any]) -> PathKind | None:
    """Whether a field is the path of a file or of a folder; None if it is not a path."""
    return setting.metadata.get("path")


def level_of(setting: Field[Any]) -> Level:
    """Who needs a field."""
    return setting.metadata.get("level", "advanced")


def field_docs(config_class: type) -> dict[str, str]:
    """{field: the string below it} of a dataclass, read from its source, each in one line."""
    body = ast.parse(textwrap.dedent(inspect.getsource(config_class))).body[0].body  # type: ignore[attr-defined]
    docs = {}
    for statement, following in itertools.pairwise(body):
        if (
            isinstance(statement, ast.AnnAssign)
            and isinstance(statement.target, ast.Name)
            and isinstance(following, ast.Expr)
            and isinstance(following.value, ast.Constant)
        ):
            docs[statement.target.id] = " ".join(str(following.value.value).split())
    return docs
