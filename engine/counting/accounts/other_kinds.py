"""A count that is far below the number of fruit of any kind: the encoder may have taken fruit of the prompt for others.

Whether something is a fruit is more certain than which kind it is, so such a count says what else was found, and its
intervals admit it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..fruit import NEAR, Fruit, FruitCount, Tree

MOST_NAMED = 3
"""Kinds that a notice names."""


@dataclass(frozen=True, eq=False)
class AnyKind:
    """counted: the fruit of any kind, in the colours of the prompt; kinds: (F,) what each looks like, "" if that is not
    known; prompt: what counted them."""

    counted: FruitCount
    kinds: Sequence[str]
    prompt: str

    def besides(self, fruits: Sequence[Fruit]) -> list[int]:
        """Which of its fruit are none of `fruits`."""
        own = self.counted.fruits
        if not fruits:
            return list(range(len(own)))
        distances, nearest = cKDTree(np.stack([fruit.center for fruit in fruits])).query(self.counted.centers)
        return [
            index
            for index, (distance, other) in enumerate(zip(distances, nearest, strict=True))
            if distance > NEAR * max(own[index].diameter, fruits[other].diameter)
        ]


def add_other_kinds(counted: FruitCount, found: AnyKind, label: str) -> FruitCount:
    """Return the count, or if other kinds have at least as many fruit, with a notice and with intervals that admit
    these.

    The same holds for each tree of a row. label: of the counted fruit.
    """
    others = found.besides(counted.fruits)
    trees = _add_to_trees(counted, found, others)
    if _is_outnumbered(counted.count, len(others)):
        kinds = [found.kinds[index] for index in others]
        wide = replace(counted, **_widen_intervals(counted, found.counted), other_fruit=len(others), trees=trees)
        return _add_notices(wide, [_notice(label, counted.count, kinds, found.prompt)])
    doubtful = [tree for tree in trees if tree.other_fruit]
    if doubtful:
        notices = [
            f"tree {tree.number} has {tree.count} {label} and {tree.other_fruit} fruit of other kinds. If these are "
            f"{label}, count with the prompt {found.prompt}"
            for tree in doubtful
        ]
        return _add_notices(replace(counted, **_widen_intervals(counted, found.counted), trees=trees), notices)
    return counted if counted.count else _add_findings(counted, found.counted)


def _add_findings(counted: FruitCount, found: FruitCount) -> FruitCount:
    """Add to a count of 0 what is known about the 0 of any kind: what photos show, or fruit of other colours."""
    high, other_colors = (found.interval or (0, 0))[1], max(counted.other_colors, found.other_colors)
    if high <= (counted.interval or (0, 0))[1] and other_colors == counted.other_colors:
        return counted
    said = [notice for notice in found.notices if notice not in counted.notices]
    return _add_notices(replace(counted, **_widen_intervals(counted, found), other_colors=other_colors), said)


def _is_outnumbered(count: int, others: int) -> bool:
    """Whether a count may be wrong because of that many fruit of other kinds."""
    return others > 0 and others >= count


def _add_to_trees(counted: FruitCount, found: AnyKind, others: Sequence[int]) -> list[Tree]:
    """Return the trees of the row, those that other kinds outnumber with these and with intervals that admit them."""
    if len(counted.trees) != len(found.counted.trees):
        return list(counted.trees)
    on_tree = Counter(found.counted.fruits[index].tree for index in others)
    trees = []
    for tree, same in zip(counted.trees, found.counted.trees, strict=True):
        number = on_tree[same.number]
        doubtful = _is_outnumbered(tree.count, number)
        trees.append(replace(tree, **_widen_intervals(tree, same), other_fruit=number) if doubtful else tree)
    return trees


def _widen_intervals(counted: FruitCount | Tree, found: FruitCount | Tree) -> dict[str, Any]:
    """Return the intervals of a count, with the upper ends of another one if these are higher."""
    low, high = counted.interval or (counted.count, counted.count)
    least, most = counted.total_interval or (low, high)
    high = max(high, found.count, *(found.interval or ()))
    most = max(most, high, *(found.total_interval or ()))
    total = float(counted.count) if counted.total is None else counted.total
    return {"interval": (low, high), "total": total, "total_interval": (least, most)}


def _notice(label: str, count: int, kinds: Sequence[str], prompt: str) -> str:
    found = "no fruit was counted" if count == 0 else f"only {count} fruit were counted"
    return (
        f"{found} for {label}, but {len(kinds)} fruit of other kinds were found{_describe_kinds(kinds)}. If these are "
        f"{label}, count with the prompt {prompt}"
    )


def _describe_kinds(kinds: Sequence[str]) -> str:
    """Return ', most of which look like lemon (25) and orange (9)'; empty if no kind is known."""
    common = Counter(filter(None, kinds)).most_common(MOST_NAMED)
    if not common:
        return ""
    *first, last = [f"{kind} ({number})" for kind, number in common]
    return f", most of which look like {' and '.join(filter(None, [', '.join(first), last]))}"


def _add_notices(counted: FruitCount, notices: Sequence[str]) -> FruitCount:
    return replace(counted, notices=[*counted.notices, *notices])
