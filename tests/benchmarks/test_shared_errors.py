"""The part of errors that trees of a species share, and what it does to sums."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fruitlangs.benchmarks.evidence.records import read_records
from fruitlangs.benchmarks.evidence.tables import TABLES, _select_measured_trees
from fruitlangs.benchmarks.ladder.stages import END_TO_END, TRUE_POSES
from fruitlangs.benchmarks.shared_errors import (
    MeasuredTree,
    estimate_shared_error,
    intraclass_correlation,
    measure_held_sums,
    measure_held_sums_left_out,
)
from fruitlangs.engine.block.totals import SHARED_ALL, SHARED_VISIBLE

TREE = MeasuredTree(true=100, low=90.0, high=110.0)


def test_the_correlation_is_that_of_a_published_example() -> None:
    """Four judges' ratings of six targets: ICC(1,1) is 0.17, its 95 % interval -0.13 to 0.72 (Shrout & Fleiss 1979)."""
    ratings = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
    found = intraclass_correlation(ratings)
    assert (found.value, found.low, found.high) == pytest.approx((0.166, 0.0, 0.723), abs=5e-4)


def test_the_correlation_of_groups_of_several_sizes_is_their_common_part() -> None:
    random = np.random.default_rng(0)
    groups = [random.normal(random.normal(0.0, 3.0), 4.0, size).tolist() for size in random.integers(1, 6, 4000)]
    assert intraclass_correlation(groups).value == pytest.approx(9.0 / 25.0, abs=0.03)


def test_equal_members_correlate_fully_and_a_correlation_is_not_below_0() -> None:
    assert intraclass_correlation([[1.0, 1.0], [2.0, 2.0]]).value == 1.0
    assert intraclass_correlation([[0.0, 2.0], [1.0, 1.0]]).value == 0.0


@pytest.mark.parametrize("groups", [[], [[1.0, 2.0]], [[1.0], [2.0]]])
def test_too_few_groups_or_members_are_an_error(groups: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="members in"):
        intraclass_correlation(groups)


def test_the_error_of_a_tree_is_the_log_ratio_of_the_middle_of_its_interval_to_the_truth() -> None:
    assert replace(TREE, low=50.0, high=128.0).log_error == pytest.approx(math.log(0.8))
    assert replace(TREE, low=0.0, high=20_000.0).log_error == pytest.approx(0.0)
    alike = {"apple": [replace(TREE, true=150)] * 3, "pear": [replace(TREE, true=80)] * 3}
    assert estimate_shared_error(alike).value == 1.0


def test_sums_of_trees_with_one_error_hold_only_if_it_is_taken_as_shared() -> None:
    same = [replace(TREE, true=108), replace(TREE, true=109)]
    assert measure_held_sums(same, 1.0, 3) == 1.0
    assert measure_held_sums(same, 0.0, 3) == 0.0
    opposite = [replace(TREE, true=108), replace(TREE, true=92)]
    assert measure_held_sums(opposite, 0.0, 3) == 0.75  # of 8 draws, 3 times 108 and 3 times 92 do not hold


def test_what_is_left_out_has_the_shared_part_of_the_others() -> None:
    shifted = [replace(TREE, true=108), replace(TREE, true=109)]
    apart = {"apple": shifted, "pear": [replace(TREE, true=91), replace(TREE, true=92)], "plum": shifted}
    assert estimate_shared_error(apart).value > 0.9
    assert measure_held_sums_left_out(apart, 3) == pytest.approx(2.0 / 3.0)  # apple and plum alone are alike


@pytest.mark.parametrize(("number", "used"), [("visible", SHARED_VISIBLE), ("total", SHARED_ALL)])
def test_the_shared_parts_are_those_of_the_measured_trees_counted_from_photos_alone(number: str, used: float) -> None:
    found = [
        estimate_shared_error(_select_measured_trees(read_records(), stage, number))
        for stage in (END_TO_END, TRUE_POSES)
    ]
    assert used == pytest.approx(found[0].value, abs=0.05)
    assert used > found[1].value


def test_the_table_has_a_line_for_each_number_and_origin_of_the_cameras() -> None:
    lines = TABLES["shared-errors"](read_records()).splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:]] == [
        "visible, photos alone", "all, photos alone", "visible, true cameras", "all, true cameras",
    ]  # fmt: skip
    assert lines[2].startswith("| visible, photos alone | 0.47 (0.04–0.84) | 92 % | 81 % | 90 % | 90 % |")
    assert TABLES["shared-errors"]([]) == ""
