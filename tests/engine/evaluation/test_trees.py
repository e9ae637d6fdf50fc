"""Counts by tree on hand-made rows with known answers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.regions.row import check_trees, trees_of_row
from fruitlangs.engine.errors import ConfigError, CountingError, FormatError
from fruitlangs.engine.evaluation.trees import (
    TreeCounts,
    TreePlaces,
    assign_to_trees,
    compare,
    places_of,
    read_places,
    tally,
)
from fruitlangs.engine.evaluation.truth import read_truth

DIAGONAL = np.array([[0.0, 0, 1], [3, 4, 1.2], [6, 8, 0.9]])
"""Three trees 5 apart on a row that runs across the axes."""
UP, RIGHT = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])


def points(places: np.ndarray) -> TreePlaces:
    return TreePlaces(np.arange(1, len(places) + 1), places, places)


def counts(*values: int) -> TreeCounts:
    return TreeCounts(np.arange(1, len(values) + 1), np.array(values))


def test_a_fruit_belongs_to_the_nearest_tree_along_the_row() -> None:
    along, across = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    fruit = np.array([2.4 * along - 3 * across, 2.6 * along + 3 * across, 7.6 * along + [0, 0, 4]])
    assert assign_to_trees(fruit, points(DIAGONAL), UP).tolist() == [1, 2, 3]


def test_a_fruit_more_than_half_a_spacing_beyond_the_row_belongs_to_none() -> None:
    along = np.array([0.6, 0.8, 0.0])
    fruit = np.array([-2.3 * along, -2.8 * along, 12.3 * along, 12.8 * along]) + [0, 0, 1]
    assert assign_to_trees(fruit, points(DIAGONAL), UP).tolist() == [1, 0, 3, 0]


BLOCK = np.array([[x, y, 0.1 * x] for y in (0.0, 4.0) for x in (0.0, 2.0, 4.0)])
"""Two rows of three trees, 2 apart in the row and 4 between the rows, on a slope."""


def test_fruit_of_every_row_of_a_block_belong_to_their_own_trees() -> None:
    random = np.random.default_rng(0)
    owners = np.repeat(np.arange(6), 50)
    angle, reach = random.uniform(0, 2 * np.pi, 300), random.uniform(0, 0.95, 300)
    around = np.stack([reach * np.cos(angle), reach * np.sin(angle), random.uniform(0, 3, 300)], axis=1)
    row = trees_of_row(BLOCK[owners] + around, CountConfig(tree_places=tuple(BLOCK.ravel())), UP, RIGHT)
    assert row is not None
    np.testing.assert_array_equal(row.numbers, owners + 1)


@pytest.mark.parametrize(
    "far", [(17.0, 2.0, 1.0), (2.0, -2.1, 1.0), (5.2, 0.0, 1.0), (2.0, 6.2, 1.0), (-1.2, 0.5, 1.0)]
)
def test_a_fruit_farther_away_than_trees_are_apart_belongs_to_none(far: tuple[float, float, float]) -> None:
    assert assign_to_trees(np.array([far]), points(BLOCK), UP).tolist() == [0]


@given(turn=st.floats(0, 7), scale=st.floats(0.01, 100), shift=st.floats(-50, 50), order=st.permutations(range(6)))
def test_the_tree_of_a_fruit_does_not_depend_on_frame_scale_or_order(
    turn: float, scale: float, shift: float, order: list[int]
) -> None:
    fruit = np.array([[0.3, 0.2, 1], [2.6, 3.5, 2], [4.4, 0.9, 0], [30.0, 1.0, 1], [-0.5, 4.7, 1]])
    turned = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]]) * scale
    plain = assign_to_trees(fruit, points(BLOCK), UP)
    moved = assign_to_trees(fruit @ turned.T + shift, points((BLOCK @ turned.T + shift)[order]), UP)
    renumbered = np.array([0, *(np.array(order) + 1)])
    np.testing.assert_array_equal(renumbered[moved], plain)


def test_boxes_hold_their_fruit_and_the_nearer_middle_wins_where_they_overlap() -> None:
    boxes = TreePlaces(np.array([4, 7]), np.array([[0.0, 0, 0], [0.8, 0, 0]]), np.array([[1.0, 1, 1], [2.0, 1, 1]]))
    fruit = np.array([[0.85, 0.5, 0.5], [0.98, 0.5, 0.5], [1.5, 0.5, 0.5], [0.5, 0.5, 1.5]])
    assert assign_to_trees(fruit, boxes, UP).tolist() == [4, 7, 7, 0]


def test_nothing_counted_is_no_trees_and_no_trees_take_nothing() -> None:
    assert assign_to_trees(np.zeros((0, 3)), points(DIAGONAL), UP).tolist() == []
    assert assign_to_trees(DIAGONAL, points(np.zeros((0, 3))), UP).tolist() == [0, 0, 0]


def test_a_lone_tree_takes_every_fruit() -> None:
    assert assign_to_trees(DIAGONAL * 100, points(np.zeros((1, 3))), UP).tolist() == [1, 1, 1]


def test_a_tree_stands_at_the_mean_of_its_fruit_and_fruit_of_no_tree_do_not_count() -> None:
    places = places_of(np.array([[0.0, 0, 0], [2, 0, 0], [9, 9, 9], [5, 1, 0]]), np.array([3, 3, 0, 1]))
    assert places.numbers.tolist() == [1, 3]
    assert places.low.tolist() == [[5, 1, 0], [1, 0, 0]]


def test_comparison_gives_known_errors() -> None:
    comparison = compare(counts(10, 20, 30), np.array([1] * 9 + [2] * 22 + [3] * 30 + [0] * 4))
    assert comparison.counted.tolist() == [9, 22, 30]
    assert comparison.elsewhere == 4
    assert comparison.mape == pytest.approx((0.1 + 0.1 + 0.0) / 3)
    assert comparison.bias == pytest.approx(1 / 3)
    assert comparison.r2 == pytest.approx(1 - 5 / 200)


def test_a_perfect_row_has_no_error_and_r2_one() -> None:
    comparison = compare(counts(1, 3), np.array([2, 1, 2, 2]))
    assert (comparison.mape, comparison.bias, comparison.r2) == (0.0, 0.0, 1.0)


def test_a_bare_tree_counts_in_the_bias_but_not_in_the_percentage() -> None:
    comparison = compare(counts(0, 4), np.array([1, 2, 2, 2, 2]))
    assert (comparison.mape, comparison.bias) == (0.0, 0.5)


def test_figures_without_a_denominator_are_not_numbers() -> None:
    assert np.isnan(compare(counts(5, 5), np.array([1, 2])).r2)
    empty = compare(counts(), np.array([0, 0]))
    assert np.isnan([empty.mape, empty.bias, empty.r2]).all()
    assert empty.elsewhere == 2


def test_tally_counts_trees_that_have_nothing() -> None:
    assert tally(np.array([2, 2, 0, 5]), np.array([5, 2, 3])).counts.tolist() == [2, 0, 1]


def test_tree_numbers_follow_the_labels_and_may_be_missing_for_some(tmp_path: Path) -> None:
    common = {"center": [0, 0, 0], "diameter": 1, "visible": True, "visible_fraction": 1}
    trees = [{"label": "apple", "tree": 2}, {"label": "pear", "tree": 1}, {"label": "apple", "tree": None}]
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({"fruits": [{**common, **fruit} for fruit in [*trees, {"label": "apple"}]]}))
    apples, fruit = read_truth(path, {"apple"}).trees, read_truth(path).trees
    assert apples is not None
    assert fruit is not None
    assert (apples.tolist(), fruit.tolist()) == ([2, 0, 0], [2, 1, 0, 0])


def test_places_are_read_as_points_or_boxes(tmp_path: Path) -> None:
    path = tmp_path / "trees.txt"
    path.write_text("1 0 0 0\n2, 1, 0, 0\n".replace(",", ""))
    assert not read_places(path).are_boxes
    path.write_text("1,0,0,0,1,1,1\n2,3,1,1,2,0,0\n")
    assert read_places(path).are_boxes
    assert read_places(path).low.tolist() == [[0, 0, 0], [2, 0, 0]]


@pytest.mark.parametrize(
    "content", ["1 0 0\n", "1 0 0 0 0\n", "1 0 0 0\n1 1 0 0\n", "0 0 0 0\n", "1.5 0 0 0\n", "a b\n"]
)
def test_a_bad_table_of_trees_says_what_is_expected(content: str, tmp_path: Path) -> None:
    (tmp_path / "trees.txt").write_text(content)
    with pytest.raises(FormatError, match="number x y z"):
        read_places(tmp_path / "trees.txt")


def row_of_fruit(loads: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Fruit of trees 5 apart on a row that runs across the axes, and the number of each one's tree."""
    random, numbers = np.random.default_rng(2), np.repeat(np.arange(1, len(loads) + 1), loads)
    along = random.uniform(-1.6, 1.6, len(numbers)) + 5.0 * numbers
    across, heights = random.uniform(-1.5, 1.5, len(numbers)), random.uniform(0, 3, len(numbers))
    return np.stack([0.6 * along - 0.8 * across, 0.8 * along + 0.6 * across, heights], axis=1), numbers


@pytest.mark.parametrize("loads", [(40, 40, 40), (12, 60, 25, 50), (30,)])
def test_trees_are_found_by_their_fruit_and_numbered_as_the_first_camera_sees_them(loads: tuple[int, ...]) -> None:
    fruit, numbers = row_of_fruit(loads)
    row, back = (trees_of_row(fruit, CountConfig(trees=len(loads)), UP, side) for side in (RIGHT, -RIGHT))
    assert row is not None
    assert back is not None
    np.testing.assert_array_equal(row.numbers, numbers)
    np.testing.assert_array_equal(back.numbers, len(loads) + 1 - numbers)
    np.testing.assert_allclose(row.places, [fruit[numbers == tree].mean(axis=0) for tree in range(1, len(loads) + 1)])


def test_shuffling_moving_turning_and_scaling_a_row_leaves_its_trees_alone() -> None:
    fruit, numbers = row_of_fruit((12, 60, 25))
    random = np.random.default_rng(1)
    order, turn = random.permutation(len(fruit)), np.linalg.qr(random.normal(size=(3, 3)))[0]
    row = trees_of_row(0.03 * fruit[order] @ turn.T + 7.0, CountConfig(trees=3), turn @ UP, turn @ RIGHT)
    assert row is not None
    np.testing.assert_array_equal(row.numbers, numbers[order])


def test_given_trees_keep_their_order_and_their_height_does_not_matter() -> None:
    fruit, numbers = row_of_fruit((20, 20, 20))
    feet = np.array([[0.6 * 5 * tree, 0.8 * 5 * tree, height] for tree, height in ((3, 0.0), (1, 9.0), (2, -4.0))])
    row = trees_of_row(fruit, CountConfig(tree_places=tuple(feet.ravel())), UP, RIGHT)
    assert row is not None
    np.testing.assert_array_equal(row.places, feet)
    np.testing.assert_array_equal(row.numbers, np.array([0, 2, 3, 1])[numbers])


def test_fruit_far_beyond_given_trees_belong_to_none() -> None:
    fruit, numbers = row_of_fruit((20, 20, 20))
    feet = (3.0, 4.0, 0.0, 6.0, 8.0, 0.0)
    row = trees_of_row(fruit, CountConfig(tree_places=feet), UP, RIGHT)
    assert row is not None
    np.testing.assert_array_equal(row.numbers, np.where(numbers == 3, 0, numbers))


def test_given_trees_without_fruit_keep_their_places() -> None:
    row = trees_of_row(np.zeros((0, 3)), CountConfig(tree_places=tuple(DIAGONAL.ravel())), UP, RIGHT)
    assert row is not None
    np.testing.assert_array_equal(row.places, DIAGONAL)
    assert row.numbers.tolist() == []


@pytest.mark.parametrize("second", [(0.0, 0.0, 2.0), (0.1, -0.1, 2.0), (0.0, 0.0, -1e-3)])
def test_given_trees_that_stand_above_one_another_are_an_error(second: tuple[float, float, float]) -> None:
    places = (5.0, 0.0, 0.0, 0.0, 0.0, 0.0, *second)
    with pytest.raises(ConfigError, match=r"--count\.tree-places: trees 2 and 3 have the same position"):
        check_trees(CountConfig(tree_places=places), UP)
    check_trees(CountConfig(tree_places=places), np.array([0.0, 1.0, 0.0]))


def test_trees_on_a_slope_are_no_error() -> None:
    check_trees(CountConfig(tree_places=(0.0, 0.0, 0.0, 1.0, 0.0, 2.0)), UP)
    check_trees(CountConfig(tree_places=(0.0, 0.0, 0.0)), UP)
    check_trees(CountConfig(trees=3), UP)


def test_fruit_in_fewer_places_than_trees_are_an_error_that_names_the_way_out() -> None:
    with pytest.raises(CountingError, match=r"3 trees and the fruit hang about 2 places.*--count\.tree-places"):
        trees_of_row(np.repeat(DIAGONAL[:2], 4, axis=0), CountConfig(trees=3), UP, RIGHT)


def test_a_single_tree_is_where_its_fruit_are_also_with_one_fruit() -> None:
    row = trees_of_row(DIAGONAL[:1], CountConfig(trees=1), UP, RIGHT)
    assert row is not None
    assert (row.numbers.tolist(), row.places.tolist()) == ([1], DIAGONAL[:1].tolist())


def test_without_fruit_or_a_wish_for_trees_there_are_none() -> None:
    assert trees_of_row(np.zeros((0, 3)), CountConfig(trees=3), UP, RIGHT) is None
    assert trees_of_row(DIAGONAL, CountConfig(), UP, RIGHT) is None


def test_fewer_fruit_than_trees_is_an_error_that_names_the_way_out() -> None:
    with pytest.raises(CountingError, match=r"4 trees and only 3 fruit.*--count\.tree-places"):
        trees_of_row(DIAGONAL, CountConfig(trees=4), UP, RIGHT)
