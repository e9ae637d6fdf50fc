"""Fruit by tree of a row: which tree a counted fruit belongs to, and counts per tree compared with the true ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..counting.fruit import NO_TREE
from ..counting.regions.row import nearest_tree
from ..errors import FormatError
from .number_table import read_numbers

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class TreePlaces:
    """T trees. numbers: (T,) from 1; low, high: (T, 3) corners of each tree's box, equal if it is a point."""

    numbers: IntArray
    low: FloatArray
    high: FloatArray

    @property
    def are_boxes(self) -> bool:
        """Whether every tree has a box rather than a point."""
        return bool((self.high > self.low).all())


@dataclass(frozen=True, eq=False)
class TreeCounts:
    """Fruit of T trees. trees: (T,) their numbers, ascending; counts: (T,)."""

    trees: IntArray
    counts: IntArray


@dataclass(frozen=True, kw_only=True, eq=False)
class TreeComparison:
    """Counted against true fruit of T trees.

    trees, true, counted: (T,); elsewhere: counted fruit that belong to no tree. mape: mean of |counted - true| ÷ true
    over trees with fruit; bias: mean of counted - true; r2: share of the variance between trees that the count
    explains, 1 - Σ(counted - true)² ÷ Σ(true - mean)². Without a denominator a figure is NaN.
    """

    trees: IntArray
    true: IntArray
    counted: IntArray
    elsewhere: int
    mape: float
    bias: float
    r2: float


def tally(numbers: IntArray, trees: IntArray) -> TreeCounts:
    """The number of fruit of each of `trees`, given the tree numbers (M,) of the fruit."""
    ordered = np.unique(trees)
    return TreeCounts(ordered, np.array([int((numbers == tree).sum()) for tree in ordered], dtype=np.int64))


def places_of(centers: FloatArray, numbers: IntArray) -> TreePlaces:
    """Trees at the mean of their true fruit; centers: (M, 3), numbers: (M,)."""
    trees = np.unique(numbers[numbers != NO_TREE])
    means = np.array([centers[numbers == tree].mean(axis=0) for tree in trees]).reshape(-1, 3)
    return TreePlaces(trees, means, means)


def assign_to_trees(centers: FloatArray, places: TreePlaces, up: FloatArray) -> IntArray:
    """(P,) number of the tree of each fruit at (P, 3).

    With boxes: the box that contains it, the one with the nearest centre if there are several. With points: see
    `nearest_tree`. up: (3,) unit, away from the ground.
    """
    middles = 0.5 * (places.low + places.high)
    if len(middles) == 0 or len(centers) == 0:
        return np.full(len(centers), NO_TREE, dtype=np.int64)
    if places.are_boxes:
        inside = ((centers[:, None] >= places.low) & (centers[:, None] <= places.high)).all(axis=2)
        distances = np.where(inside, np.linalg.norm(centers[:, None] - middles, axis=2), np.inf)
        return np.where(inside.any(axis=1), places.numbers[distances.argmin(axis=1)], NO_TREE)
    return np.append(places.numbers, NO_TREE)[nearest_tree(centers, middles, up)]


def compare(true: TreeCounts, counted: IntArray) -> TreeComparison:
    """Compare true counts with the tree numbers (P,) of counted fruit."""
    found = np.array([int((counted == tree).sum()) for tree in true.trees], dtype=np.int64)
    errors = (found - true.counts).astype(np.float64)
    bearing = true.counts > 0
    spread = float(((true.counts - true.counts.mean()) ** 2).sum()) if len(errors) else 0.0
    return TreeComparison(
        trees=true.trees,
        true=true.counts,
        counted=found,
        elsewhere=len(counted) - int(found.sum()),
        mape=float(np.abs(errors[bearing] / true.counts[bearing]).mean()) if bearing.any() else float("nan"),
        bias=float(errors.mean()) if len(errors) else float("nan"),
        r2=1.0 - float((errors**2).sum()) / spread if spread > 0.0 else float("nan"),
    )


def read_places(path: Path) -> TreePlaces:
    """Read trees from rows of `number x y z`, or of `number x y z x y z` with two corners of a box.

    Raises:
        FormatError: the file is no such table, or a number is not a whole one from 1, or stands twice.
    """
    expected = "number x y z, or number and two corners x y z x y z, a tree"
    rows = read_numbers(path, columns=4, expected=expected)
    numbers = rows[:, 0].astype(np.int64)
    if rows.shape[1] not in (4, 7):
        raise FormatError(f"{path}: has {rows.shape[1]} columns. Expected rows of {expected}")
    if (numbers != rows[:, 0]).any() or (numbers < 1).any() or len(np.unique(numbers)) < len(numbers):
        raise FormatError(f"{path}: its trees are not numbered 1, 2, … each once. Expected rows of {expected}")
    ends = rows[:, 1:].reshape(len(rows), -1, 3)
    return TreePlaces(numbers, ends.min(axis=1), ends.max(axis=1))
