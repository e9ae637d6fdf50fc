"""What is drawn for a place: the same whatever lies elsewhere, and spread evenly."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.counting.geometry.random_streams import FINENESS, RandomStreams, even_turns

PLACES = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))


def test_what_is_drawn_for_a_place_does_not_depend_on_the_others():
    few = np.arange(3, 200, 7)
    np.testing.assert_array_equal(RandomStreams.draw(PLACES[few], 5).starts, RandomStreams.draw(PLACES, 5).starts[few])


def test_another_seed_or_place_draws_otherwise():
    starts = RandomStreams.draw(PLACES, 5).starts
    assert (np.abs(starts - RandomStreams.draw(PLACES, 6).starts) > 0).all()
    assert len(np.unique(starts)) == starts.size


def test_what_is_drawn_fills_the_unit_interval():
    starts = RandomStreams.draw(np.random.default_rng(1).uniform(-1.0, 1.0, (4000, 3)), 0).starts
    assert starts.min() >= 0.0
    assert starts.max() < 1.0
    assert np.sort(starts, axis=0) == pytest.approx(np.repeat(np.linspace(0, 1, 4000)[:, None], 3, axis=1), abs=0.03)


def test_rounding_of_single_precision_moves_hardly_any_position_to_another_stream():
    rounded = PLACES.astype(np.float32).astype(np.float64)
    same = (RandomStreams.draw(PLACES, 0).starts == RandomStreams.draw(rounded, 0).starts).all(axis=1)
    assert same.mean() > 0.99


def test_gaussians_in_one_place_go_on_with_each_others_numbers():
    """Twice the same Gaussian draws the points of one that draws twice as many."""
    references = np.array([[0.1, 0.2, 0.3], [0.5, 0.5, 0.5], [0.1, 0.2, 0.3 + 0.1 / FINENESS]])
    streams = RandomStreams.draw(references, 0)
    numbers = streams.number(np.array([0, 0, 1, 2, 2, 2]))
    assert numbers.tolist() == [0, 1, 0, 2, 3, 4]


def test_the_points_of_a_place_face_all_sides_evenly_and_those_of_a_share_of_turns_too():
    streams, owner = RandomStreams.draw(PLACES[:1], 0), np.zeros(400, np.int64)
    numbers = streams.number(owner)
    directions, turns = streams.directions(owner, numbers), streams.turns(owner, numbers)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(400))
    assert np.linalg.norm(directions.mean(axis=0)) < 0.02
    assert (turns < 0.25).sum() == pytest.approx(100, abs=2)
    assert np.linalg.norm(directions[turns < 0.25].mean(axis=0)) < 0.1


def test_of_points_without_a_place_an_even_part_is_every_so_manyth():
    chosen = np.flatnonzero(even_turns(1000) < 0.2)
    assert np.diff(chosen).max() <= 8
    assert len(chosen) == pytest.approx(200, abs=2)
