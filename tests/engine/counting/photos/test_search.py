"""The order in which places are searched."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from fruitlangs.engine.counting.photos.search import (
    FIRST,
    PEAKS,
    PEAKS_OF_FRUIT,
    group_fruit,
    likely_places,
    search_photos,
)


def test_a_place_with_a_low_score_comes_before_the_many_around_a_clear_fruit() -> None:
    clear = np.stack(np.meshgrid(*[np.arange(3) * 0.3 + 0.1] * 3), axis=-1).reshape(-1, 3)
    faint = np.array([[5.0, 5.0, 5.0]])
    scores = {tuple(place): 100.0 - index for index, place in enumerate(clear)} | {tuple(faint[0]): 1.0}
    rest = np.random.default_rng(0).uniform(10.0, 50.0, (1000, 3))
    views = SimpleNamespace(
        places=lambda *_: np.concatenate([rest, faint, clear]),
        score=lambda places, *_: np.array([scores.get(tuple(place), 0.0) for place in places]),
    )
    found = likely_places(views, np.zeros((0, 3)), 1.0, np.eye(3, 4))
    assert len(found) == len(clear) + 1
    assert np.flatnonzero((found == faint).all(axis=1)) == [FIRST]
    assert np.array_equal(found[:FIRST], clear[:FIRST])


def test_no_fruit_is_found_nearer_than_two_thirds_of_a_diameter_to_a_likelier_one() -> None:
    """Of three places in a row the middle one is .6 diameters from the first, the likeliest; the last one .75."""
    places = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 0.75, 0.0]])
    odds = dict(zip(map(tuple, places), (4.0, 3.0, 2.0), strict=True))
    views = SimpleNamespace(places=lambda *_: places, score=lambda places, *_: np.ones(len(places)))
    verifier = SimpleNamespace(
        views=views,
        surroundings=SimpleNamespace(fruit=np.zeros((0, 3))),
        verify=lambda places, *_: (np.array([odds[tuple(place)] for place in places]), np.zeros((len(places), 3))),
    )
    found = search_photos(verifier, 1.0, np.eye(3, 4))
    assert sorted(map(tuple, found.centers)) == [tuple(places[0]), tuple(places[2])]


AWAY = np.array([500.0, 0.0, 0.0])
RING = 40.0 * np.stack([np.cos(np.arange(12)), np.sin(np.arange(12)), np.zeros(12)], axis=1)
"""Cameras around a tree at the origin whose fruit and places lie within 10 diameters."""


def tree(seed: int, fruit: int, photos: float, places: int = 20_000) -> SimpleNamespace:
    """Fruit of a tree that so many photos frame, and places with scores that grow with the number of photos."""
    rng = np.random.default_rng(seed)
    spots = np.stack(np.unravel_index(rng.permutation(30**3)[:places], (30, 30, 30)), axis=1) - 15.0
    scores = photos * rng.uniform(0.01, 1.0, places)
    return SimpleNamespace(fruit=rng.uniform(-8.0, 8.0, (fruit, 3)), places=spots, scores=scores, photos=photos)


def places_of(*trees: tuple[SimpleNamespace, np.ndarray], eyes: np.ndarray) -> np.ndarray:
    """The places that are verified of trees, each moved."""
    places = np.concatenate([each.places + shift for each, shift in trees])
    fruit = np.concatenate([each.fruit + shift for each, shift in trees])
    framed = np.repeat([each.photos for each, _ in trees], [len(each.fruit) for each, _ in trees])
    scores = dict(zip(map(tuple, places), np.concatenate([each.scores for each, _ in trees]), strict=True))
    views = SimpleNamespace(
        places=lambda *_: places,
        score=lambda asked, *_: np.array([scores[tuple(place)] for place in asked]),
        choose=lambda *_: (None, np.tile(framed[:, None], 5)),
        eyes=eyes,
    )
    return likely_places(views, fruit, 1.0, np.eye(3, 4))


@pytest.mark.parametrize("photos", [60.0, 10.0])
def test_the_places_of_a_tree_do_not_depend_on_a_tree_far_away_with_more_photos(photos: float) -> None:
    few, many = tree(0, 110, 10.0), tree(1, 150, photos)
    alone = places_of((few, AWAY), eyes=RING + AWAY)
    together = places_of((many, 0.0 * AWAY), (few, AWAY), eyes=np.concatenate([RING, RING + AWAY]))
    assert len(alone) == PEAKS_OF_FRUIT * 110
    assert sorted(map(tuple, together[together[:, 0] > 250.0])) == sorted(map(tuple, alone))
    assert (together[:, 0] < 250.0).sum() == PEAKS_OF_FRUIT * 150


def test_the_places_of_a_tree_do_not_depend_on_its_neighbor_with_more_photos() -> None:
    few, many, beside = tree(0, 110, 10.0), tree(1, 150, 60.0), AWAY / 15.0
    alone = places_of((few, beside), eyes=RING + 0.5 * beside)
    together = places_of((many, 0.0 * beside), (few, beside), eyes=RING + 0.5 * beside)
    assert sorted(map(tuple, together[together[:, 0] > 16.0])) == sorted(map(tuple, alone))


def test_in_a_part_with_few_fruit_as_many_places_are_verified_as_in_a_scene_with_few() -> None:
    few, many = tree(0, 12, 10.0), tree(1, 150, 60.0)
    together = places_of((many, 0.0 * AWAY), (few, AWAY), eyes=np.concatenate([RING, RING + AWAY]))
    assert (together[:, 0] > 250.0).sum() == PEAKS


def groups(framed: list[float]) -> list[int]:
    """The sizes of the groups of fruit of one tree that so many photos frame."""
    fruit = np.random.default_rng(0).uniform(-8.0, 8.0, (len(framed), 3))
    views = SimpleNamespace(choose=lambda *_: (None, np.tile(np.array(framed)[:, None], 5)), eyes=RING)
    return np.bincount(group_fruit(views, fruit, 1.0)).tolist()


def test_fruit_compete_unless_many_of_a_tree_are_in_less_than_half_the_photos() -> None:
    assert groups([60.0] * 80 + [31.0] * 40) == [120]
    assert groups([29.0] * 40 + [60.0] * 80) == [80, 40]
    assert groups([60.0] * 110 + [9.0] * 10) == [120]
    assert groups([60.0] * 40 + [25.0] * 40 + [10.0] * 40) == [40, 40, 40]
    assert groups([60.0]) == [1]
