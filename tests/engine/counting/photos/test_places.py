"""Places with their own radii."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.counting.photos.places import NO_PLACES, Places, find_clear, keep_strongest


def places(seed: int, count: int) -> Places:
    rng = np.random.default_rng(seed)
    return Places(rng.random((count, 3)), rng.uniform(0.02, 0.15, count))


def nearer(one: Places, other: Places, share: float) -> np.ndarray:
    """Which pairs are nearer than `share` of their mean diameter, each computed alone."""
    distances = np.linalg.norm(one.centers[:, None] - other.centers, axis=2)
    return distances < share * (one.radii[:, None] + other.radii) / 2.0 * 2.0


@pytest.mark.parametrize("share", [0.3, 0.65, 1.2])
def test_the_places_that_stay_apart_are_those_of_a_brute_force(share: float) -> None:
    found, strengths = places(0, 300), np.random.default_rng(1).random(300).round(1)
    close, kept = nearer(found, found, share), list[int]()
    for index in sorted(range(300), key=lambda index: -strengths[index]):
        if not close[index, kept].any():
            kept.append(index)
    assert keep_strongest(found, strengths, share).tolist() == kept
    assert 10 < len(kept) < 290


@pytest.mark.parametrize("share", [0.3, 0.65, 1.2])
def test_the_places_that_are_clear_of_others_are_those_of_a_brute_force(share: float) -> None:
    found, others = places(0, 300), places(2, 60)
    clear = find_clear(found, others, share)
    assert np.array_equal(clear, ~nearer(found, others, share).any(axis=1))
    assert 0 < clear.sum() < 300


def test_places_at_exactly_the_distance_stay_both() -> None:
    pair = Places(np.array([[0.0, 0.0, 0.0], [0.75, 0.0, 0.0]]), np.array([0.5, 1.0]))
    assert keep_strongest(pair, np.array([1.0, 2.0]), 0.5).tolist() == [1, 0]
    assert keep_strongest(pair, np.array([1.0, 2.0]), 0.51).tolist() == [1]


def test_without_places_nothing_is_kept_and_without_others_everything_is_clear() -> None:
    assert len(keep_strongest(NO_PLACES, np.zeros(0), 1.0)) == 0
    assert find_clear(NO_PLACES, places(0, 3), 1.0).tolist() == []
    assert find_clear(places(0, 3), NO_PLACES, 1.0).tolist() == [True] * 3
    assert NO_PLACES.largest == 0.0


def test_joined_places_come_one_after_the_other_with_their_radii() -> None:
    one, other = places(0, 3), places(1, 2)
    both = Places.join([one, NO_PLACES, other])
    assert len(both) == 5
    assert np.array_equal(both.centers[3:], other.centers)
    assert np.array_equal(both.radii, [*one.radii, *other.radii])
    assert np.array_equal(both.select(both.radii > 0.05).radii, both.radii[both.radii > 0.05])
