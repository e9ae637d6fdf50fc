"""What the review of a tree decided, as a file in the folder of its result, which the tables of the block use."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from ..counting.accounts.review import Decision, Spot, Standing
from ..errors import FormatError
from ..storage.files import write_text

REVIEW = "review.json"


@dataclass(frozen=True, kw_only=True)
class ReviewedFruit:
    """A fruit after a review. tree: its number, None if it is of none; standing: "" without a decision; center: in the
    scene frame; axes: half axes, diameter, volume: in the unit of the result; color: mean sRGB."""

    tree: int | None
    standing: Standing
    probability: float
    center: tuple[float, float, float]
    axes: tuple[tuple[float, float, float], ...]
    diameter: float
    volume: float
    color: tuple[int, int, int]

    @property
    def counts(self) -> bool:
        return self.standing != "rejected"


@dataclass(frozen=True, kw_only=True, eq=False)
class Review:
    """The fruit of a tree after a review, and the decisions that led to them, which can be replayed."""

    fruits: Sequence[ReviewedFruit]
    decisions: Sequence[Decision] = ()


def write_review(folder: Path, set_id: str, review: Review) -> None:
    """Store a review in the folder of a result. set_id: names the set of result files that was reviewed.

    Raises:
        OutputError: the folder cannot be written.
    """
    document = {
        "set_id": set_id,
        "fruits": [asdict(fruit) for fruit in review.fruits],
        "decisions": [
            {
                "action": each.action,
                "time": each.time,
                "reason": each.reason,
                "before": [_entry(spot) for spot in each.before],
                "after": [_entry(spot) for spot in each.after],
            }
            for each in review.decisions
        ],
    }
    write_text(folder / REVIEW, json.dumps(document, indent=1) + "\n")


def read_review(folder: Path, set_id: str) -> Review | None:
    """The review of a result; None without one, or if it is of an earlier count.

    Raises:
        FormatError: the file is damaged.
    """
    path = folder / REVIEW
    if not path.is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["set_id"] != set_id:
            return None
        fruits = [_fruit(each, each["standing"]) for each in document["fruits"]]
        decisions = [
            Decision(**{**each, **{when: tuple(map(_spot, each[when])) for when in ("before", "after")}})
            for each in document["decisions"]
        ]
    except (AttributeError, KeyError, OSError, TypeError, ValueError) as error:
        raise FormatError(f"{path} is damaged ({error}). Delete it, and store the review again") from error
    return Review(fruits=fruits, decisions=decisions)


def fruit_of(document: Mapping[str, Any], review: Review | None) -> list[ReviewedFruit]:
    """The fruit of a fruits.json after its review, rejected ones included; a fruit that the user added belongs to the
    nearest tree."""
    if review is None:
        return [_fruit(entry, "") for entry in document["fruits"]]
    trees = document.get("trees") or []
    feet = np.array([tree["position"] for tree in trees], np.float64).reshape(-1, 3)
    numbers = [tree["number"] for tree in trees]

    def place(fruit: ReviewedFruit) -> ReviewedFruit:
        if not numbers or fruit.tree is not None or fruit.standing != "added":
            return fruit
        return replace(fruit, tree=numbers[int(np.linalg.norm(feet - fruit.center, axis=1).argmin())])

    return [place(fruit) for fruit in review.fruits]


def _fruit(entry: Mapping[str, Any], standing: Standing) -> ReviewedFruit:
    """A fruit from its entry in fruits.json or review.json.

    Raises:
        KeyError, TypeError, ValueError: it lacks a number, or has one that makes no sense.
    """
    fruit = ReviewedFruit(
        tree=entry["tree"],
        standing=standing,
        probability=float(entry["probability"]),
        center=_triple(entry["center"]),
        axes=tuple(map(_triple, entry["axes"])),
        diameter=float(entry["diameter"]),
        volume=float(entry["volume"]),
        color=tuple(entry["color"]),
    )
    red, green, blue = fruit.color
    if standing not in get_args(Standing) or not all(0 <= value <= 255 for value in (red, green, blue)):
        raise ValueError(f"standing {standing!r}, color {fruit.color}")
    if not all(0.0 <= value < math.inf for value in (fruit.probability, fruit.diameter, fruit.volume)):
        raise ValueError(f"a fruit of diameter {fruit.diameter} and volume {fruit.volume}")
    return fruit


def _triple(numbers: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, numbers)
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"{numbers} are not three numbers")
    return x, y, z


def _entry(spot: Spot) -> dict[str, Any]:
    return {"id": spot.id, "label": spot.label, "center": spot.center.tolist(), "axes": spot.axes.tolist()}


def _spot(entry: Mapping[str, Any]) -> Spot:
    center, axes = np.array(entry["center"], np.float64), np.array(entry["axes"], np.float64)
    return Spot(int(entry["id"]), str(entry["label"]), center.reshape(3), axes.reshape(3, 3))
