"""Fruit keep their numbers from count to count."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fruitlangs.engine.counting.ids import NOBODY, KnownFruit, number
from fruitlangs.engine.report.results import SCHEMA, known_fruit

LINE = np.stack([np.arange(4.0), np.zeros(4), np.zeros(4)], axis=1)
"""Four fruit of diameter 1 in a row."""


def as_known(ids: list[int], centers: np.ndarray, last: int) -> KnownFruit:
    return KnownFruit(np.array(ids), centers, last)


def test_a_first_count_numbers_from_one_in_the_order_given():
    assert number(LINE, np.array([2, 0, 3, 1]), 1.0).tolist() == [2, 4, 1, 3]


def test_a_fruit_that_moved_by_less_than_half_a_diameter_keeps_its_number():
    assert number(LINE + 0.4, np.arange(4), 2.0, as_known([9, 7, 8, 3], LINE, 9)).tolist() == [9, 7, 8, 3]
    assert number(LINE + 0.4, np.arange(4), 1.0, as_known([9, 7, 8, 3], LINE, 9)).tolist() == [10, 11, 12, 13]


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


def result(folder: Path, **changes: object) -> Path:
    """A fruits.json with what a reader relies on."""
    provenance = {"source": "", "inputs_sha256": "abc", "encoder": "", "prompts": [], "training": {}}
    provenance["training"] = {"psnr": None, "ssim": None}
    fruits = [{"id": 3, "label": "apple", "center": [1.0, 2.0, 3.0], "diameter": 0.1}]
    document = {"schema": SCHEMA, "set_id": "", "fruits": fruits, "config": {}, "files": {}, "provenance": provenance}
    folder.mkdir(exist_ok=True)
    (folder / "fruits.json").write_text(json.dumps({**document, "metres_per_unit": None, **changes}))
    return folder


def test_an_earlier_result_of_the_same_inputs_is_known(tmp_path: Path):
    known = known_fruit(result(tmp_path, last_id=12), "abc")
    assert (known.ids.tolist(), known.centers.tolist(), known.last) == ([3], [[1.0, 2.0, 3.0]], 12)
    assert known_fruit(result(tmp_path), "abc").last == 3  # written before ids were kept


@pytest.mark.parametrize("changes", [{"schema": "another/9"}, {"fruits": [{"id": "three"}]}, {}])
def test_results_that_cannot_be_read_or_are_of_other_inputs_number_nothing(tmp_path: Path, changes: dict):
    inputs = "abc" if changes else "another scene"
    assert known_fruit(result(tmp_path, **changes), inputs) is NOBODY
    assert known_fruit(tmp_path / "gone", "abc") is NOBODY
