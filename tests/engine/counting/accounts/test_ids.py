"""Fruit keep their numbers from count to count."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fruit_examples import count_of, fruit
from hypothesis import given
from hypothesis import strategies as st

from fruitlangs.engine.counting.accounts.ids import NO_FRUIT, KnownFruit, number
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.report.results import SCHEMA, dump, fruits_document, parse_known_fruit
from fruitlangs.engine.result_folder import ResultFolder

LINE = np.stack([np.arange(4.0), np.zeros(4), np.zeros(4)], axis=1)
"""Four fruit of diameter 1 in a row."""


def as_known(ids: list[int], centers: np.ndarray, last: int, diameter: float = 1.0) -> KnownFruit:
    return KnownFruit(np.array(ids), centers, np.full(len(ids), diameter), last)


def test_a_first_count_numbers_from_one_in_the_order_given():
    assert number(LINE, np.array([2, 0, 3, 1]), 1.0).tolist() == [2, 4, 1, 3]


def test_a_fruit_that_moved_by_less_than_half_a_diameter_keeps_its_number():
    large, small = (as_known([9, 7, 8, 3], LINE, 9, diameter) for diameter in (2.0, 1.0))
    assert number(LINE + 0.4, np.arange(4), 2.0, large).tolist() == [9, 7, 8, 3]
    assert number(LINE + 0.4, np.arange(4), 1.0, small).tolist() == [10, 11, 12, 13]


def test_one_sphere_about_many_fruit_takes_the_number_of_none_next_to_its_middle():
    known = as_known([1, 2, 3, 4], LINE, 4)
    assert number(np.array([[1.5, 0.6, 0.0]]), np.arange(1), 5.0, known).tolist() == [5]


def test_a_new_fruit_gets_a_number_that_none_ever_had():
    known = as_known([1, 2, 3], LINE[:3], 8)  # 4 to 8 were fruit of counts before
    assert number(LINE, np.arange(4), 1.0, known).tolist() == [1, 2, 3, 9]


def test_two_fruit_never_take_the_number_of_one():
    pair = np.array([[-0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    assert sorted(number(pair, np.arange(2), 1.0, as_known([5], LINE[:1], 5)).tolist()) == [5, 6]


@given(st.permutations(range(4)), st.integers(0, 4))
def test_numbers_do_not_depend_on_the_order_in_which_fruit_are_found(order: list[int], kept: int):
    known = as_known(list(range(1, kept + 1)), LINE[:kept], kept)
    shuffled = number(LINE[order], np.argsort(order), 1.0, known)
    assert shuffled[np.argsort(order)].tolist() == [1, 2, 3, 4]


TRAINING = {"psnr": None, "ssim": None}
PROVENANCE = {"source": "", "inputs_sha256": "abc", "encoder": "", "prompts": [], "training": TRAINING}


def known_in(folder: Path, inputs: str = "abc") -> KnownFruit:
    return parse_known_fruit(ResultFolder(folder).read(), inputs)


def written(folder: Path, found: FruitCount, metres_per_unit: float | None = None) -> KnownFruit:
    """What is known after a count into `folder` that found these."""
    document = fruits_document(
        found,
        config={},
        provenance=PROVENANCE,
        files={},
        metres_per_unit=metres_per_unit,
        known=known_in(folder) if (folder / "fruits.json").is_file() else NO_FRUIT,
    )
    (folder / "fruits.json").write_text(dump(document))
    return known_in(folder)


def test_fruit_that_a_count_does_not_find_are_known_to_the_next_one_where_they_were(tmp_path: Path):
    written(tmp_path, count_of(fruit(1, 0.0), fruit(2, 1.0), last_id=2))
    nothing = written(tmp_path, count_of(last_id=2))
    assert (nothing.ids.tolist(), nothing.centers[:, 0].tolist(), nothing.last) == ([1, 2], [0.0, 1.0], 2)
    half = written(tmp_path, count_of(fruit(2, 1.0), last_id=2))
    assert sorted(half.ids.tolist()) == [1, 2]


def test_the_newest_place_of_a_fruit_is_the_one_that_is_known(tmp_path: Path):
    written(tmp_path, count_of(fruit(1, 0.0), last_id=1))
    moved = written(tmp_path, count_of(fruit(1, 0.03), last_id=1))
    assert (moved.ids.tolist(), moved.centers[:, 0].tolist()) == ([1], [0.03])


def test_sizes_are_known_in_scene_units_whatever_the_scale_since(tmp_path: Path):
    written(tmp_path, count_of(fruit(1, 0.0), last_id=1), metres_per_unit=2.0)
    known = written(tmp_path, count_of(fruit(2, 1.0, diameter=0.1), last_id=2), metres_per_unit=0.5)
    assert known.diameters[np.argsort(known.ids)].tolist() == [0.08, 0.1]


def result(folder: Path, **changes: object) -> Path:
    """A fruits.json with what a reader relied on before earlier fruit were kept."""
    fruits = [{"id": 3, "label": "apple", "center": [1.0, 2.0, 3.0], "diameter": 0.1}]
    document = {"schema": SCHEMA, "set_id": "", "fruits": fruits, "config": {}, "files": {}, "provenance": PROVENANCE}
    folder.mkdir(exist_ok=True)
    (folder / "fruits.json").write_text(json.dumps({**document, "metres_per_unit": None, **changes}))
    return folder


def test_an_earlier_result_of_the_same_inputs_is_known(tmp_path: Path):
    known = known_in(result(tmp_path, last_id=12))
    assert (known.ids.tolist(), known.centers.tolist(), known.last) == ([3], [[1.0, 2.0, 3.0]], 12)
    assert known_in(result(tmp_path)).last == 3  # written before ids were kept


def test_results_of_other_inputs_number_nothing(tmp_path: Path):
    assert known_in(result(tmp_path), "another scene") is NO_FRUIT


DAMAGED = [{"schema": "another/9"}, {"fruits": [{"id": "three"}]}, {"earlier_fruits": [{"id": 1, "center": [0.0]}]}]


@pytest.mark.parametrize("changes", DAMAGED)
def test_results_that_cannot_be_read_say_so(tmp_path: Path, changes: dict):
    with pytest.raises(FormatError):
        ResultFolder(result(tmp_path, **changes)).read()
