"""A count that fruit of other kinds outnumber says so, and its intervals admit them."""

from __future__ import annotations

from typing import Any

import numpy as np
from fruit_examples import count_of, fruit

from fruitlangs.engine.counting.accounts.other_kinds import AnyKind, add_other_kinds
from fruitlangs.engine.counting.fruit import FruitCount, Tree
from fruitlangs.engine.report.words import count_text, explain_nothing_found

LEMONS = [fruit(number, 0.3 * number) for number in range(1, 39)]
KINDS = ["lemon"] * 25 + ["orange"] * 9 + ["plum"] * 2 + [""] * 2
INTERVALS: dict[str, Any] = {"interval": (38, 54), "likely": 41.0, "total": 50.0, "total_interval": (40, 66)}


def any_kind(*fruits: Any, **changes: Any) -> AnyKind:
    fruits = fruits or tuple(LEMONS)
    given = INTERVALS | changes
    return AnyKind(count_of(*fruits, **given), KINDS[: len(fruits)], "fruit")


def tree(number: int, count: int, **changes: Any) -> Tree:
    return Tree(number, np.zeros(3), count, **changes)


def counted(number: int, **changes: Any) -> FruitCount:
    """A count of the first fruit; those of any kind have the same centres."""
    return count_of(*LEMONS[:number], **changes)


def test_a_0_where_other_fruit_hang_admits_them_and_says_what_they_look_like() -> None:
    found = add_other_kinds(counted(0), any_kind(), "plum")
    assert (found.count, found.other_fruit) == (0, 38)
    assert found.interval == (0, 54)
    assert found.total_interval == (0, 66)
    assert found.notices[-1] == (
        "no fruit was counted for plum, but 38 fruit of other kinds were found, most of which look like lemon (25), "
        "orange (9) and plum (2). If these are plum, count with the prompt fruit"
    )
    assert count_text(found).startswith("0 visible fruit (90 % interval 0–54)")
    assert explain_nothing_found(found, 0.5, None) == "the 38 fruit that were found look like other kinds"


def test_a_count_that_others_outnumber_says_so() -> None:
    found = add_other_kinds(counted(3, interval=(3, 5), total=4.0, total_interval=(3, 7)), any_kind(), "plum")
    assert (found.count, found.other_fruit) == (3, 35)
    assert (found.interval, found.total, found.total_interval) == ((3, 54), 4.0, (3, 66))
    assert found.notices[-1].startswith("only 3 fruit were counted for plum, but 35 fruit of other kinds were found")


def test_half_of_all_fruit_is_too_few_and_more_than_half_is_a_count() -> None:
    assert add_other_kinds(counted(19), any_kind(), "plum").other_fruit == 19
    ordinary = counted(20, interval=(20, 22))
    assert add_other_kinds(ordinary, any_kind(), "plum") is ordinary


def test_a_wider_interval_of_the_count_stays() -> None:
    wide = counted(1, interval=(0, 90), total=2.0, total_interval=(0, 99))
    found = add_other_kinds(wide, any_kind(), "plum")
    assert (found.interval, found.total_interval) == ((0, 90), (0, 99))


def test_fruit_are_the_same_within_half_a_diameter() -> None:
    near, far = fruit(1, 0.3 + 0.035), fruit(1, 0.3 + 0.045)
    assert len(any_kind().besides([near])) == 37
    assert len(any_kind().besides([far])) == 38


def test_a_0_of_any_kind_passes_on_what_photos_show() -> None:
    shown = "no fruit was counted, but photos show 7 places that match fruit"
    none = AnyKind(count_of(interval=(0, 7), total=0.0, total_interval=(0, 7), notices=["blurred", shown]), [], "fruit")
    found = add_other_kinds(counted(0, notices=["blurred"]), none, "plum")
    assert (found.interval, found.total_interval, found.other_fruit) == ((0, 7), (0, 7), 0)
    assert list(found.notices) == ["blurred", shown]
    certain = counted(4, interval=(4, 5))
    assert add_other_kinds(certain, none, "plum") is certain


def test_a_tree_of_the_row_that_others_outnumber_says_so_although_the_row_has_more() -> None:
    own = [fruit(number, 0.3 * number, tree=1) for number in range(1, 21)]
    others = [fruit(number, 0.3 * number, tree=2) for number in range(21, 31)]
    row = count_of(*own, interval=(20, 22), total=21.0, total_interval=(20, 24), trees=[tree(1, 20), tree(2, 0)])
    trees = [tree(1, 20, interval=(20, 22)), tree(2, 10, interval=(10, 13), total_interval=(10, 15))]
    everything = AnyKind(count_of(*own, *others, trees=trees, **INTERVALS), ["lemon"] * 30, "fruit")
    found = add_other_kinds(row, everything, "plum")
    assert [each.other_fruit for each in found.trees] == [0, 10]
    assert [each.interval for each in found.trees] == [None, (0, 13)]
    assert found.trees[1].total_interval == (0, 15)
    assert (found.interval, found.other_fruit) == ((20, 54), 0)
    assert found.notices[-1].startswith("tree 2 has 0 plum and 10 fruit of other kinds")
