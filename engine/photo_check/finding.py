"""The values of a check: what was found, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from PIL import Image

from .cost import StageCost

Severity = Literal["problem", "warning"]
Kind = Literal[
    "few photos",
    "unreadable",
    "RAW",
    "all alike",
    "groups",
    "gap",
    "no overlap",
    "blur",
    "soft",
    "exposure",
    "white balance",
    "cameras",
    "orientation",
    "narrow fruit",
    "memory",
]
LABELS: dict[Kind, str] = {
    "unreadable": "cannot be read",
    "groups": "another group",
    "gap": "next to a gap",
    "no overlap": "no overlap",
    "blur": "blurred",
    "exposure": "exposure jump",
    "white balance": "colour jump",
    "cameras": "another camera",
    "orientation": "turned",
}
"""What the contact sheet writes on a photo. The other findings concern all photos."""


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One finding: a sentence, what to do, and the names of the photos concerned, in order.

    A problem is likely to make the run fail or the count wrong; a warning makes it less accurate.
    """

    kind: Kind
    severity: Severity
    sentence: str
    advice: str
    photos: Sequence[str] = ()

    @property
    def text(self) -> str:
        return f"{self.sentence}. {self.advice}"


@dataclass(frozen=True, kw_only=True, eq=False)
class CheckedPhoto:
    """A photo: sharpness as a share of that of its neighbours, brightness in [0, 1] (median, linear), number of photos
    with common content, and a small picture; None for a photo that cannot be read."""

    name: str
    sharpness: float = 0.0
    brightness: float = 0.0
    links: int = 0
    thumbnail: Image.Image | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class PhotoCheck:
    """The check of a folder of photos: problems come first in the findings, photos are in name order."""

    folder: Path
    photos: Sequence[CheckedPhoto]
    findings: Sequence[Finding]
    costs: Sequence[StageCost]

    @property
    def counts(self) -> str:
        """'2 problems, 1 warning'."""
        problems = sum(finding.severity == "problem" for finding in self.findings)
        warnings = len(self.findings) - problems
        return f"{_plural(problems, 'problem')}, {_plural(warnings, 'warning')}"

    @property
    def seconds(self) -> float:
        """Expected seconds of the whole run."""
        return sum(cost.seconds for cost in self.costs)

    @property
    def bytes(self) -> int:
        """Expected peak memory of the run, in bytes."""
        return max((cost.bytes for cost in self.costs), default=0)


def list_names(names: Sequence[str], most: int = 3) -> str:
    """'a.jpg, b.jpg, c.jpg and 5 more'."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def photos_text(number: int) -> str:
    return _plural(number, "photo")


def _plural(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
