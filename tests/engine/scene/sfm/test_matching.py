"""Matches between photos: exact, along epipolar lines, and of which pairs."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.scene.sfm.features import Features
from fruitlangs.engine.scene.sfm.matching import MOST_ANGLE, MOST_RATIO, match, match_along_lines
from fruitlangs.engine.scene.sfm.pairs import choose_closing_pairs, choose_first_pairs, choose_retry_pairs
from fruitlangs.engine.scene.sfm.retrieval import similarities

ACROSS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Fundamental matrix of a camera that moved sideways: a feature stays in its row."""


def descriptors(count: int, seed: int) -> np.ndarray:
    """(count, 128) 8-bit descriptors of length 512, as RootSIFT has them."""
    values = np.random.default_rng(seed).gamma(0.3, size=(count, 128))
    unit = np.sqrt(values / values.sum(1, keepdims=True))
    return np.rint(512.0 * unit).clip(0, 255).astype(np.uint8)


def noisy(given: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 4.0, given.shape)
    return (given + noise).clip(0, 255).astype(np.uint8)


def features(positions: np.ndarray, of: np.ndarray) -> Features:
    return Features(positions.astype(np.float32), np.ones(len(of), np.float32), of)


def scattered(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(0.0, 600.0, (count, 2))


def by_definition(one: np.ndarray, other: np.ndarray) -> set[tuple[int, int]]:
    """Mutual nearest neighbours by angle that pass the ratio test, in float64."""
    products = one.astype(np.float64) @ other.astype(np.float64).T
    angles = np.arccos(np.clip(products / 512.0**2, 0.0, 1.0))
    ranked = np.sort(angles, axis=1)
    found = set()
    for i, j in enumerate(products.argmax(1)):
        mutual = products[i, j] == products[:, j].max()
        if mutual and ranked[i, 0] < MOST_ANGLE and ranked[i, 0] < MOST_RATIO * ranked[i, 1]:
            found.add((i, int(j)))
    return found


def test_a_photo_that_was_not_placed_is_matched_with_all_others_of_a_small_capture() -> None:
    assert choose_retry_pairs(frozenset({2}), None, 4) == [(0, 2), (1, 2), (2, 3)]


def test_in_a_long_walk_it_is_matched_with_the_most_similar_placed_photos_only() -> None:
    count, missing = 330, frozenset(range(165, 330))
    similarity = -np.abs(np.subtract.outer(np.arange(count), np.arange(count))).astype(np.float32)
    pairs = choose_retry_pairs(missing, similarity, count)
    assert len(pairs) == 165 * 40
    assert {i for i, j in pairs if j == 200} == set(range(125, 165))
    assert len(choose_retry_pairs(frozenset(range(count)), similarity, count)) < 40 * count


def test_matches_are_those_of_the_definition() -> None:
    one = descriptors(1500, 0)
    other = np.concatenate([noisy(one[200:1400], 1), descriptors(900, 2)])
    found = {tuple(pair) for pair in match(features(scattered(1500, 3), one), features(scattered(2100, 4), other))}
    assert found == by_definition(one, other)
    assert len(found) > 1000


@pytest.mark.parametrize(("count", "others"), [(0, 5), (5, 0), (5, 1)])
def test_photos_with_almost_no_features_have_no_matches(count: int, others: int) -> None:
    one, other = (
        features(scattered(count, 0), descriptors(count, 0)),
        features(scattered(others, 1), descriptors(others, 1)),
    )
    assert match(one, other).shape == (0, 2)


def rows_and_others() -> tuple[Features, Features]:
    """300 features that stay in their rows and change their look, among 900 others in each photo."""
    at, of = scattered(300, 0), descriptors(300, 1)
    moved = at + np.column_stack([np.full(300, 40.0), np.zeros(300)])
    one = features(np.concatenate([at, scattered(900, 2)]), np.concatenate([of, descriptors(900, 3)]))
    other = features(np.concatenate([moved, scattered(900, 4)]), np.concatenate([noisy(of, 5), descriptors(900, 6)]))
    return one, other


def test_matches_along_lines_are_on_them() -> None:
    one, other = rows_and_others()
    found = match_along_lines(ACROSS, one, other, 2.0)
    assert found is not None
    assert np.abs(one.positions[found[:, 0], 1] - other.positions[found[:, 1], 1]).max() < 2.0
    assert (found[:, 0] == found[:, 1]).mean() > 0.9
    assert (found < 300).all(axis=1).sum() > 280


def test_lines_that_show_no_more_than_chance_give_nothing() -> None:
    one, other = rows_and_others()
    upwards = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])  # a feature stays in its column
    assert match_along_lines(upwards, one, other, 2.0) is None


def test_the_most_similar_photo_shows_the_same_place() -> None:
    places = [descriptors(400, seed) for seed in range(4)]
    photos = [features(scattered(400, seed), noisy(places[seed % 4], seed)) for seed in range(8)]
    similarity = similarities(photos, 0)
    np.fill_diagonal(similarity, -1.0)
    assert similarity.argmax(1).tolist() == [4, 5, 6, 7, 0, 1, 2, 3]


def test_a_short_capture_is_matched_in_all_pairs() -> None:
    assert choose_first_pairs(None, 5, PhotosConfig()) == [(i, j) for i in range(5) for j in range(i + 1, 5)]


def test_a_long_capture_is_matched_with_neighbours_and_similar_photos_only() -> None:
    similarity = np.zeros((200, 200), np.float32)
    similarity[3, 150] = similarity[150, 3] = 1.0
    pairs = choose_first_pairs(similarity, 200, PhotosConfig(exhaustive_up_to=10, overlap=3))
    assert {(i, i + step) for i in range(197) for step in (1, 2, 3)} <= set(pairs)
    assert (3, 150) in pairs
    assert len(pairs) == len(set(pairs)) < 200 * (3 + 8) + 1


def test_neighbours_of_photos_that_meet_again_are_matched_too() -> None:
    found = choose_closing_pairs([(0, 1), (5, 90)], [(5, 90), (4, 89)], 100, PhotosConfig(overlap=10))
    assert set(found) == {(i, j) for i in (4, 5, 6) for j in (89, 90, 91)} - {(5, 90), (4, 89)}
