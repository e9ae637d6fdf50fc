"""Matching of centres: the same as by one table of all distances, in memory that grows with the pairs within reach."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from fruitlangs.engine.counting.accounts.ids import KnownFruit, number
from fruitlangs.engine.counting.geometry.matching import match_centers, pairs_within


@given(st.integers(0, 10_000), st.integers(1, 40), st.integers(1, 40), st.sampled_from([0.05, 0.2, 0.6, 2.0]))
def test_pairs_are_those_of_the_hungarian_method_over_all_distances(seed: int, p: int, t: int, reach: float) -> None:
    rng = np.random.default_rng(seed)
    predicted, true = rng.random((p, 3)), rng.random((t, 3))
    reaches = reach * rng.uniform(0.5, 1.0, t)
    distances = cdist(predicted, true)
    cost = np.where(distances <= reaches, distances, 1000.0)
    expected = [pair for pair in zip(*linear_sum_assignment(cost), strict=True) if cost[pair] < 1000.0]
    found = match_centers(predicted, true, reaches)
    assert list(zip(found.predicted, found.true, strict=True)) == expected
    np.testing.assert_allclose(found.distances, [distances[pair] for pair in expected])


def test_centres_at_one_place_are_matched_one_to_one() -> None:
    found = match_centers(np.zeros((3, 3)), np.zeros((2, 3)), 0.5)
    assert sorted(found.true.tolist()) == [0, 1]
    assert len(set(found.predicted.tolist())) == 2


@pytest.mark.parametrize("radius", [0.0, -1.0])
def test_without_a_reach_nothing_is_matched(radius: float) -> None:
    assert len(match_centers(np.zeros((3, 3)), np.zeros((2, 3)), radius)) == 0


def test_a_centre_exactly_at_its_reach_is_within() -> None:
    rows, columns, distances = pairs_within(np.array([[0.3, 0.0, 0.0]]), np.zeros((1, 3)), np.array([0.3]))
    assert (rows.tolist(), columns.tolist(), distances.tolist()) == ([0], [0], [0.3])


def test_ids_of_a_long_row_need_memory_for_pairs_and_not_for_a_table() -> None:
    centers = np.random.default_rng(0).uniform(0.0, 40.0, (12_000, 3))
    known = KnownFruit(np.arange(1, 12_001), centers, np.ones(12_000), 12_000)
    tracemalloc.start()
    ids = number(centers + 0.1, np.arange(12_000), 1.0, known)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (ids == known.ids).mean() > 0.99
    assert peak < 40 * 2**20
