"""The order in which places are searched."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from fruitlangs.engine.counting.photos.search import FIRST, likely_places


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
