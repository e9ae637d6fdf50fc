"""A fruit whose colour no certain fruit has must be more certain itself."""

from __future__ import annotations

import numpy as np
import splats
import torch

from fruitlangs.engine.counting.photos.colours import AGAINST, ALIKE, FEWEST, colours_of, measure_unlikeness

RED, GREEN = (45.0, 25.0), (-16.0, 24.0)


def test_a_green_place_among_certain_red_fruit_loses_log_odds_and_a_red_one_none() -> None:
    colours = np.array([RED] * 10 + [RED, GREEN])
    against = measure_unlikeness(colours, np.array([5.0] * 10 + [1.0, 1.0]))
    assert against[-1] == AGAINST
    assert (against[:-1] == 0.0).all()


def test_places_of_a_colour_that_some_certain_fruit_have_lose_nothing() -> None:
    colours = np.array([RED] * 30 + [GREEN] * (ALIKE + 1))
    assert (measure_unlikeness(colours, np.array([5.0] * 33 + [1.0])) == 0.0).all()


def test_places_of_unknown_colour_lose_nothing() -> None:
    colours = np.array([RED] * 10 + [(np.nan, np.nan)])
    assert measure_unlikeness(colours, np.array([5.0] * 10 + [1.0]))[-1] == 0.0


def test_without_enough_certain_fruit_no_place_loses_log_odds() -> None:
    colours = np.array([RED] * 10 + [GREEN] * ALIKE)
    assert (measure_unlikeness(colours, np.array([2.0] * 10 + [5.0] * ALIKE)) == 0.0).all()


def test_colours_of_places_are_those_of_the_gaussians_below_their_points() -> None:
    gaussians = splats.random_gaussians(2, 0)
    gaussians.sh[:, 0] = (torch.tensor([(0.8, 0.1, 0.1), (0.1, 0.6, 0.1)]) - 0.5) / 0.28209479
    points = np.repeat([0, 1, 0], [FEWEST, FEWEST, FEWEST - 1])
    owners = np.repeat([0, 1, 2], [FEWEST, FEWEST, FEWEST - 1])
    red, green, few = colours_of(gaussians, points, owners, 3)
    assert red[0] > 40.0
    assert green[0] < -30.0
    assert np.isnan(few).all()
