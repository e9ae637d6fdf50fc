"""Clusters of dense points compared with scikit-learn's DBSCAN, and in memory that grows with the points alone."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from fruitlangs.engine.counting.published.density import Density, dbscan, dense_clusters


def clumps(count: int, seed: int) -> np.ndarray:
    """(P, 3) points around a few places, so that clusters have many border points, some of two clusters."""
    random = np.random.default_rng(seed)
    places = random.uniform(-1.0, 1.0, (5, 3))
    return places[random.integers(5, size=count)] + random.normal(0.0, 0.25, (count, 3))


@settings(max_examples=60)
@given(st.integers(1, 400), st.floats(0.02, 3.0), st.integers(1, 30), st.integers(0, 1000))
def test_clusters_and_their_numbers_are_those_of_scikit_learn(count: int, reach: float, least: int, seed: int) -> None:
    points = clumps(count, seed)
    expected = DBSCAN(eps=reach, min_samples=least).fit_predict(points)
    np.testing.assert_array_equal(dbscan(points, reach, least), expected)


def test_a_border_point_of_two_clusters_is_of_the_one_whose_core_point_comes_first() -> None:
    left = [[x, 0.0, 0.0] for x in (-1.4, -1.2, -1.0, -0.9)]
    right = [[-x, 0.0, 0.0] for x, _, _ in left]
    between = [[0.0, 0.0, 0.0]]
    assert dbscan(np.array(left + between + right), 0.95, 4).tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1]
    assert dbscan(np.array(right + between + left), 0.95, 4).tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1]


@pytest.mark.parametrize("count", [0, 3])
def test_of_too_few_points_there_is_no_cluster(count: int) -> None:
    points = np.zeros((count, 3))
    assert dbscan(points, 1.0, 4).tolist() == [-1] * count
    assert dense_clusters(points, 1.0, Density(np.full(count, count), count), 0.5) == []


def test_points_in_one_place_take_memory_in_proportion_to_their_number() -> None:
    points = np.random.default_rng(0).normal(0.0, 0.01, (20_000, 3))
    dbscan(points[:100], 1.0, 4)  # compiles
    tracemalloc.start()
    labels = dbscan(points, 1.0, 4)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert (labels == 0).all()
    assert peak < 1000 * len(points)  # bytes; all pairs would be 160,000 a point
