"""The order in which places are searched."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from balls_in_photos import balls_of, verifier_of
from scipy.spatial import cKDTree

from fruitlangs.engine.counting.photos.places import Places
from fruitlangs.engine.counting.photos.search import (
    FIRST,
    KEPT_APART,
    PEAKS,
    PEAKS_OF_FRUIT,
    SMALLER,
    FoundInPhotos,
    find_likely_places,
    group_fruit,
    search_photos,
    shrink_to_usual,
)
from fruitlangs.engine.counting.photos.verifier import Verdicts


def test_a_place_with_a_low_score_comes_before_the_many_around_a_clear_fruit() -> None:
    clear = np.stack(np.meshgrid(*[np.arange(3) * 0.3 + 0.1] * 3), axis=-1).reshape(-1, 3)
    faint = np.array([[5.0, 5.0, 5.0]])
    scores = {tuple(place): 100.0 - index for index, place in enumerate(clear)} | {tuple(faint[0]): 1.0}
    rest = np.random.default_rng(0).uniform(10.0, 50.0, (1000, 3))
    views = SimpleNamespace(
        places=lambda *_: np.concatenate([rest, faint, clear]),
        score=lambda places, *_: np.array([scores.get(tuple(place), 0.0) for place in places]),
    )
    found = find_likely_places(views, np.zeros((0, 3)), 1.0, np.eye(3, 4))
    assert len(found) == len(clear) + 1
    assert np.flatnonzero((found == faint).all(axis=1)) == [FIRST]
    assert np.array_equal(found[:FIRST], clear[:FIRST])


def test_no_fruit_is_found_nearer_than_two_thirds_of_a_diameter_to_a_likelier_one() -> None:
    """Of three places in a row the middle one is .6 diameters from the first, the likeliest; the last one .75."""
    places = np.array([[0.0, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 0.75, 0.0]])
    odds = dict(zip(map(tuple, places), (4.0, 3.0, 2.0), strict=True))
    views = SimpleNamespace(
        places=lambda *_: places,
        score=lambda places, *_: np.ones(len(places)),
        choose=lambda *_: (None, None),
        measured=lambda centers, *_: (np.full(len(centers), np.nan), np.zeros(len(centers))),
    )
    verifier = SimpleNamespace(
        views=views,
        surroundings=SimpleNamespace(fruit=np.zeros((0, 3))),
        with_size=lambda *_: verifier,
        verify=lambda found, *_: steady(np.array([odds[tuple(place)] for place in found.centers])),
    )
    found = search_photos(verifier, 1.0, np.eye(3, 4))
    assert sorted(map(tuple, found.places.centers)) == [tuple(places[0]), tuple(places[2])]
    assert found.diameter == 1.0
    assert found.radius_sds.tolist() == [SD, SD]


SD = 0.07
"""Standard deviation of the logarithm of every radius."""


def steady(odds: np.ndarray) -> Verdicts:
    """Verdicts that change no place."""
    return Verdicts(odds, np.zeros((len(odds), 3)), np.zeros(len(odds)), np.full(len(odds), SD))


class Line:
    """Stands for views and verifier of places along x: a radius by place and number of verdict, odds by place, and a
    step of wandering places. Radii that are measured before verdicts are those of the first one, from very many
    pixels."""

    def __init__(self, xs: list[float], radius: Callable[[float, int], float], odds: dict[float, float]) -> None:
        self.xs, self.radius, self.odds = np.array(xs), radius, odds
        self.number, self.searched = 0, list[float]()
        self.views, self.surroundings = self, SimpleNamespace(fruit=np.zeros((0, 3)))
        self.step = 0.0

    def with_size(self, diameter: float, *_: float) -> Line:
        self.diameter = diameter
        return self

    def places(self, radius: float, *_: object) -> np.ndarray:
        self.searched.append(radius)
        return np.stack([self.xs, 0.0 * self.xs, 0.0 * self.xs], axis=1)

    def score(self, places: np.ndarray, *_: object) -> np.ndarray:
        return np.ones(len(places))

    def choose(self, *_: object) -> tuple[None, None]:
        return None, None

    def measured(self, centers: np.ndarray, *_: object) -> tuple[np.ndarray, np.ndarray]:
        return np.array([self.radius(x, 1) for x, _, _ in centers]), np.full(len(centers), 1e9)

    def verify(self, found: Places, *_: object) -> Verdicts:
        self.number += 1
        starts = np.array(sorted(self.odds))
        nearest = [starts[np.abs(starts - x).argmin()] for x, _, _ in found.centers]
        odds = np.array([self.odds[start] for start in nearest])
        moves = np.where(odds[:, None] == WANDERING, [[self.step, 0.0, 0.0]], 0.0)
        radii = np.array([self.radius(x, self.number) for x in (found.centers + moves)[:, 0]])
        return Verdicts(odds, moves, np.log(radii / found.radii), np.full(len(odds), SD))


WANDERING = 0.0
"""Log odds of places that move: they are no known fruit."""
FAR = [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]


def test_places_are_searched_again_with_the_size_that_was_measured() -> None:
    line = Line(FAR, lambda *_: 0.5, dict.fromkeys(FAR, 5.0))
    found = search_photos(line, 1.5, np.eye(3, 4))  # type: ignore[arg-type]
    assert line.searched == pytest.approx([0.75, 0.5])
    assert line.diameter == pytest.approx(1.0)
    assert found.diameter == pytest.approx(1.0)


def test_a_size_that_is_nearly_right_is_corrected_without_another_search() -> None:
    """Of six likely places only three fruit remain, too few to measure the size again."""
    pairs = [0.0, 0.3, 10.0, 10.3, 20.0, 20.3]
    line = Line(pairs, lambda *_: 0.525, dict.fromkeys(pairs, 5.0))
    found = search_photos(line, 1.0, np.eye(3, 4))  # type: ignore[arg-type]
    assert len(line.searched) == 1
    assert found.known == 3
    assert found.diameter == pytest.approx(1.05)


def test_where_sizes_vary_places_of_small_fruit_are_searched_too() -> None:
    varied = Line(FAR, lambda x, _: 0.35 if x % 20.0 else 0.65, dict.fromkeys(FAR, 5.0))
    search_photos(varied, 1.0, np.eye(3, 4))  # type: ignore[arg-type]
    assert varied.searched == pytest.approx([0.5, SMALLER * 0.5])
    alike = Line(FAR, lambda x, _: 0.48 if x % 20.0 else 0.52, dict.fromkeys(FAR, 5.0))
    search_photos(alike, 1.0, np.eye(3, 4))  # type: ignore[arg-type]
    assert alike.searched == pytest.approx([0.5])


def test_the_usual_diameter_is_that_of_the_known_fruit_at_the_end() -> None:
    line = Line(FAR, lambda _, number: 0.5 if number <= 1 else 0.6, dict.fromkeys(FAR, 5.0))
    assert search_photos(line, 1.0, np.eye(3, 4)).diameter == pytest.approx(1.2, rel=0.01)  # type: ignore[arg-type]


def test_a_place_that_moves_into_a_known_fruit_is_left_out() -> None:
    line = Line([*FAR, 51.0], lambda *_: 0.5, {**dict.fromkeys(FAR, 5.0), 50.5: WANDERING})
    line.step = -0.24
    found = search_photos(line, 1.0, np.eye(3, 4))  # type: ignore[arg-type]
    assert len(found.places) == found.known == len(FAR)


def test_a_place_has_the_radius_of_where_it_has_moved_to() -> None:
    line = Line([*FAR, 53.0], lambda x, _: 0.45 if 50.5 < x < 52.5 else 0.5, {**dict.fromkeys(FAR, 5.0), 52.0: 0.0})
    line.step = -0.4
    found = search_photos(line, 1.0, np.eye(3, 4))  # type: ignore[arg-type]
    assert found.places.centers[found.known :, 0] == pytest.approx([52.2])
    assert found.places.radii[found.known :] == pytest.approx(
        shrink_to_usual(np.array([0.45]), np.array([SD]), np.full(6, 0.5), 0.5)
    )


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
    return find_likely_places(views, fruit, 1.0, np.eye(3, 4))


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


RADIUS, BALLS = 0.08, 12


def search_balls(balls: Places, diameter: float, *, every: int = 2) -> FoundInPhotos:
    return search_photos(verifier_of(balls, diameter, every=every), diameter, np.eye(3, 4))


def radii_at(balls: Places, found: FoundInPhotos) -> np.ndarray:
    """The radius of the likely fruit that is found at each ball; NaN at balls without one, or with two."""
    likely = found.places.select(found.log_odds > 0.0)
    near = cKDTree(likely.centers).query_ball_point(balls.centers, 0.5 * balls.radii)
    return np.array([likely.radii[each[0]] if len(each) == 1 else np.nan for each in near])


@pytest.mark.parametrize("error", [0.7, 1.0, 1.3])
def test_fruit_are_found_with_their_true_size_if_the_given_one_is_thirty_per_cent_off(error: float) -> None:
    balls = balls_of(np.full(BALLS, RADIUS))
    found = search_balls(balls, error * 2.0 * RADIUS)
    assert found.diameter == pytest.approx(2.0 * RADIUS, rel=0.05)
    assert (found.log_odds > 0.0).sum() == BALLS
    assert radii_at(balls, found) == pytest.approx(balls.radii, rel=0.07)
    assert found.radius_sds[: found.known].max() < 0.15


def test_fruit_of_two_sizes_in_one_scene_keep_their_own_radii() -> None:
    balls = balls_of(np.tile([0.06, 0.09], BALLS // 2))
    found = search_balls(balls, 0.15)
    assert radii_at(balls, found) == pytest.approx(balls.radii, rel=0.08)


def test_small_fruit_that_touch_stay_two() -> None:
    """Their distance is less than that which fruit of the usual size keep from each other."""
    balls, small = balls_of(np.full(BALLS, 0.09)), 0.05
    pair = Places(np.array([[0.0, 0.0, 0.75 - small], [0.0, 0.0, 0.75 + small]]), np.full(2, small))
    found = search_balls(Places.join([balls, pair]), 0.18, every=1)
    assert 2.0 * small < KEPT_APART * found.diameter
    assert radii_at(pair, found) == pytest.approx(
        shrink_to_usual(pair.radii, np.full(2, SD), balls.radii, 0.09), rel=0.15
    )
    assert found.known == BALLS + 2


def test_equal_photos_give_equal_bytes() -> None:
    verifier = verifier_of(balls_of(np.full(BALLS, RADIUS)), 2.0 * RADIUS)
    one, other = (search_photos(verifier, 2.0 * RADIUS, np.eye(3, 4)) for _ in range(2))
    for name in ("log_odds", "radius_sds"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    assert one.places.centers.tobytes() == other.places.centers.tobytes()
    assert one.places.radii.tobytes() == other.places.radii.tobytes()
    assert (one.known, one.diameter) == (other.known, other.diameter)
