"""Neighbours among points sorted into cells, compared with brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import connected_components

from fruitlangs.engine.counting.evidence.vote_kernels import average_points
from fruitlangs.engine.counting.geometry.cells import MOST_CELLS, Cells, buffer_size, choose_apart, gather, link_points
from fruitlangs.engine.counting.geometry.random_streams import even_turns


def cloud(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-3.0, 5.0, (count, 3))


@settings(max_examples=40)
@given(st.integers(0, 200), st.floats(0.1, 20.0), st.floats(0.05, 9.0), st.integers(0, 5))
def test_as_many_points_are_near_as_brute_force_finds(count: int, size: float, reach: float, seed: int):
    points, centers = cloud(count, seed), 1.5 * cloud(30, seed + 1)
    distances = np.linalg.norm(centers[:, None] - points, axis=2)
    assert np.array_equal(Cells.of(points, size).numbers(centers, np.full(30, reach)), (distances <= reach).sum(axis=1))


def test_the_index_leads_back_to_the_points_as_they_were():
    points = cloud(500)
    cells = Cells.of(points, 0.7)
    assert np.array_equal(cells.positions, points[cells.index])
    assert (np.diff(cells.keys) >= 0).all()


def test_a_point_astronomically_far_away_does_not_hide_the_others():
    points = np.vstack([cloud(100), [1e12, -1e12, 1e12]])
    cells = Cells.of(points, 0.5)
    assert cells.shape.max() <= MOST_CELLS
    brute = (np.linalg.norm(points[:100, None] - points, axis=2) <= 1.0).sum(axis=1)
    assert np.array_equal(cells.numbers(points[:100], np.ones(100)), brute)


def test_points_that_are_kept_apart_cover_all_others():
    points = cloud(400)
    cells = Cells.of(points, 0.8)
    kept = choose_apart(cells.table, np.full(400, 1.6), np.arange(400), 0.5)
    between = np.linalg.norm(cells.positions[kept][:, None] - cells.positions[kept], axis=2)
    assert between[~np.eye(len(kept), dtype=bool)].min() >= 0.8
    assert np.linalg.norm(cells.positions[:, None] - cells.positions[kept], axis=2).min(axis=1).max() < 0.8


def test_spheres_of_other_radii_in_one_place_are_both_kept():
    cells = Cells.of(np.zeros((4, 3)), 1.0)
    radii = np.array([1.0, 1.3, 2.0, 2.2])
    assert choose_apart(cells.table, radii, np.arange(4), 0.5).tolist() == [0, 2]


def test_the_middle_of_what_is_near_is_its_mean():
    points = cloud(300)
    cells, found = Cells.of(points, 1.0), np.empty((20, 3))
    average_points(cells.table, cells.positions[:20], 1.2, found)
    for center, middle in zip(cells.positions[:20], found, strict=True):
        near = points[np.linalg.norm(points - center, axis=1) <= 1.2]
        assert middle == pytest.approx(near.mean(axis=0))


@settings(max_examples=40)
@given(st.integers(1, 200), st.floats(0.1, 5.0), st.floats(0.1, 2.0), st.integers(0, 5))
def test_points_are_linked_as_brute_force_links_them(count: int, size: float, reach: float, seed: int):
    cells = Cells.of(cloud(count, seed), size)
    near = np.linalg.norm(cells.positions[:, None] - cells.positions, axis=2) <= reach
    brute = connected_components(near, directed=False)[1]
    clusters = link_points(cells.table, reach, 0.0)
    assert np.array_equal(clusters[:, None] == clusters, brute[:, None] == brute)
    spared = link_points(cells.table, reach, reach / 5.0)  # links no more, and all that are four fifths as near
    assert (brute[spared] == brute).all()
    close = np.linalg.norm(cells.positions[:, None] - cells.positions, axis=2) <= 0.6 * reach
    assert (spared[close.nonzero()[0]] == spared[close.nonzero()[1]]).all()


@pytest.mark.parametrize("size", [0.2, 0.9])
def test_which_neighbours_are_left_when_they_are_thinned_does_not_depend_on_the_cells(size: float):
    points = cloud(3000, 4)
    turns, near = even_turns(3000), np.empty(buffer_size(50), np.int64)

    def thinned(side: float) -> list[int]:
        cells = Cells.of(points, side, turns)
        return sorted(cells.index[near[: gather(cells.table, np.ones(3), 1.8, 50, near)]])

    left = thinned(size)
    assert left == thinned(0.35)
    assert len(left) == pytest.approx(50, abs=20)
    assert (np.linalg.norm(points[left] - 1.0, axis=1) <= 1.8).all()
