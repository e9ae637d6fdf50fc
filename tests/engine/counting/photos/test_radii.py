"""Radii of fruit, measured from the offsets of their pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from balls_in_photos import RING, photo_of, views_of

from fruitlangs.engine.counting.photos.places import Places
from fruitlangs.engine.counting.photos.search import FARTHEST_SIZE, shrink_to_usual, size_places
from fruitlangs.engine.counting.photos.views import PhotoViews
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap

RADIUS = 0.08
BALL = Places(np.zeros((1, 3)), np.array([RADIUS]))
GUESSES = [0.7, 0.85, 1.0, 1.15, 1.3]


def measured(views: PhotoViews, guess: float = 1.0) -> float:
    """The radius of the ball at the origin in its radii."""
    radii, pixels = views.measured(BALL.centers, guess * BALL.radii, np.arange(len(RING))[None])
    assert pixels[0] > 100.0
    return float(radii[0]) / RADIUS


def masked(hidden: float) -> PhotoViews:
    """Views of the ball in which what is right of its middle, by `hidden` of its radius, shows no fruit."""
    pictures, maps = zip(*(photo_of(camera, BALL) for camera in RING), strict=True)
    shown = [each.probability.copy() for each in maps]
    for each in shown:
        each[:, each.shape[1] // 2 + round(hidden * 10.0) :] = 0.0
    return PhotoViews.of(pictures, [PhotoMap(p, m.offsets) for p, m in zip(shown, maps, strict=True)])


@pytest.mark.parametrize("guess", GUESSES)
def test_a_disc_gives_its_radius_whatever_the_first_guess(guess: float) -> None:
    assert measured(views_of(BALL), guess) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("guess", GUESSES)
def test_a_half_hidden_disc_gives_its_radius_whatever_the_first_guess(guess: float) -> None:
    assert measured(masked(0.0), guess) == pytest.approx(1.0, abs=0.02)


def test_a_centre_that_is_off_by_a_quarter_gives_the_same_radius() -> None:
    radii, _ = views_of(BALL).measured(BALL.centers + [0.0, 0.0, 0.25 * RADIUS], BALL.radii, np.arange(len(RING))[None])
    assert radii[0] == pytest.approx(RADIUS, rel=0.02)


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_blur_is_subtracted_in_pixels_of_the_map_if_the_view_is_drawn_at_another_size(times: float) -> None:
    maps = [photo_of(camera, BALL)[1] for camera in RING]
    drawn = [camera.resize(round(times * camera.width), round(times * camera.height)) for camera in RING]
    views = PhotoViews.of([photo_of(camera, BALL)[0] for camera in drawn], maps)
    assert measured(views) == pytest.approx(measured(views_of(BALL)), abs=0.02)


def test_a_fruit_looks_larger_by_the_blur_that_is_subtracted() -> None:
    views, pixels = views_of(BALL), RADIUS * RING[0].K[0, 0] / 2.0
    blurred = replace(views, blurs=np.zeros(len(RING)))
    assert measured(blurred) == pytest.approx(np.hypot(1.0, views.blurs[0] / pixels), abs=0.01)


def test_a_fruit_that_is_no_wider_than_the_blur_keeps_half_of_what_is_seen() -> None:
    views = views_of(BALL)
    seen = measured(replace(views, blurs=np.zeros(len(RING))))
    assert measured(replace(views, blurs=np.full(len(RING), 50.0))) == pytest.approx(0.5 * seen)


def test_without_pixels_a_radius_is_nan_with_weight_0() -> None:
    views = views_of(BALL)
    empty = replace(views, probabilities=np.zeros_like(views.probabilities))
    for each, chosen in ((empty, np.arange(4)[None]), (views, np.full((1, 4), -1))):
        radii, pixels = each.measured(BALL.centers, BALL.radii, chosen)
        assert np.isnan(radii).all()
        assert (pixels == 0.0).all()


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_pixels_with_one_offset_tell_no_radius(offset: float) -> None:
    views = views_of(BALL)
    flat = replace(views, offsets=np.full_like(views.offsets, offset))
    radii, pixels = flat.measured(BALL.centers, BALL.radii, np.arange(8)[None])
    assert np.isnan(radii[0])
    assert pixels[0] == 0.0


def test_offsets_that_point_the_wrong_way_tell_no_radius() -> None:
    views = views_of(BALL)
    radii, pixels = replace(views, offsets=-views.offsets).measured(BALL.centers, BALL.radii, np.arange(8)[None])
    assert np.isnan(radii[0])
    assert pixels[0] == 0.0


@pytest.mark.parametrize("guess", [0.8, 1.0, 1.3])
def test_a_neighbour_that_touches_changes_the_radius_by_less_than_four_per_cent(guess: float) -> None:
    towards = np.array([[0.0, 0.0, 2.0 * RADIUS]])
    pair = Places(np.concatenate([BALL.centers, towards]), np.array([RADIUS, RADIUS]))
    assert measured(views_of(pair), guess) == pytest.approx(1.0, abs=0.04)


def test_fruit_with_few_pixels_stay_near_the_usual_radius() -> None:
    views, usual = masked(-0.6), 1.4 * RADIUS
    empty = replace(views, probabilities=np.zeros_like(views.probabilities))
    assert size_places(empty, BALL, 2.0 * usual).radii == pytest.approx([usual])
    whole, part = (size_places(each, BALL, 2.0 * usual).radii[0] for each in (views_of(BALL), few_pixels()))
    assert whole == pytest.approx(RADIUS, rel=0.05)
    assert 1.1 * RADIUS < part < 0.98 * usual


def few_pixels() -> PhotoViews:
    """Two views of the ball that show a narrow part of it."""
    pictures, maps = zip(*(photo_of(camera, BALL) for camera in RING[:2]), strict=True)
    for each in maps:
        each.probability[: each.probability.shape[0] // 2] = 0.0
        each.probability[:, : each.probability.shape[1] // 2 - 2] = 0.0
        each.probability[:, each.probability.shape[1] // 2 + 2 :] = 0.0
    return PhotoViews.of(pictures, maps)


def test_a_radius_is_never_farther_from_the_usual_one_than_a_limit() -> None:
    found = size_places(views_of(BALL), BALL, 2.0 * 5.0 * RADIUS).radii[0]
    assert found >= 5.0 * RADIUS * np.exp(-FARTHEST_SIZE)


def test_two_fruit_of_different_sizes_keep_their_own_radii() -> None:
    both = Places(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]), np.array([RADIUS, 0.7 * RADIUS]))
    found = size_places(views_of(both), Places.alike(both.centers, 1.7 * RADIUS), 1.7 * RADIUS)
    assert found.radii == pytest.approx(both.radii, rel=0.05)


def test_small_fruit_that_touch_are_measured_again_around_their_own_size() -> None:
    """Around the usual size, pixels of both tell the radius of each."""
    small = 0.05
    pair = Places(np.array([[0.0, 0.0, -small], [0.0, 0.0, small]]), np.full(2, small))
    found = size_places(views_of(pair), Places.alike(pair.centers, 0.2), 0.2)
    assert found.radii == pytest.approx(pair.radii, rel=0.04)


def test_radii_of_alike_fruit_are_moved_towards_the_usual_one_and_those_of_varied_fruit_hardly() -> None:
    radii, sds = np.array([0.5, 1.0, 2.0]), np.full(3, 0.1)
    alike = shrink_to_usual(radii, sds, np.ones(20), 1.0)
    assert alike == pytest.approx(radii ** (1.44 / 2.44))
    varied = shrink_to_usual(radii, sds, np.exp(np.linspace(-0.6, 0.6, 21)), 1.0)
    assert varied == pytest.approx(radii, rel=0.08)
    assert shrink_to_usual(radii, sds, np.full(2, 9.0), 1.0) == pytest.approx(alike)


def test_the_less_certain_a_radius_is_the_nearer_it_is_to_the_usual_one() -> None:
    held = shrink_to_usual(np.full(3, 2.0), np.array([0.0, 0.1, 1.0]), np.ones(20), 1.0)
    assert held[0] == 2.0
    assert 2.0 > held[1] > held[2] > 1.0
    assert held[2] < 1.02
