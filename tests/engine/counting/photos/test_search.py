"""The order in which places are searched."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from fruitlangs.engine.counting.photos.search import FIRST, likely_places, search_photos


def test_a_place_with_a_low_score_comes_before_the_many_around_a_clear_fruit() -> None:
    clear = np.stack(np.meshgrid(*[np.arange(3) * 0.3 + 0.1] * 3), axis=-1).reshape(-1, 3)
    faint = np.array([[5.0, 5.0, 5.0]])
    scores = {tuple(place): 100.0 - index for index, place in enumerate(clear)} | {tuple(faint[0]): 1.0}
    rest = np.random.default_rng(0).uniform(10.0, 50.0, (1000, 3))
    views = SimpleNamespace(
        places=lambda *_: np.concatenate([rest, faint, clear]),
        score=lambda places, *_: np.array([scores.get(tuple(place), 0.0) for place in places]),
    )
    found = likely_places(views, 1.0, np.eye(3, 4))
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
