"""Which photos are compared with which."""

from __future__ import annotations

import numpy as np

from fruitlangs.engine.scene.sfm.refining.nearness import near_photos


def compared(places: np.ndarray, photo: int, *, most: float = np.inf) -> set[int]:
    """The photos that one is compared with if they were taken at these places (V, 2), up to a distance."""
    distance = np.linalg.norm(places - places[photo], axis=1)
    distance[(distance > most) | (distance == 0.0)] = np.inf
    row, near = near_photos(distance[None])
    assert not row.any()
    return set(near.tolist())


def to_and_fro(photos: int, height: float) -> np.ndarray:
    """Steps of .1 m along a row and back at another height."""
    along = 0.1 * np.arange(photos)
    return np.concatenate([np.column_stack([along, 0.0 * along]), np.column_stack([along[::-1], 0.0 * along + height])])


def test_a_photo_is_compared_with_the_nearest_ones_and_with_three_of_the_walk_back() -> None:
    near = compared(to_and_fro(50, height=1.5), 20)
    assert near == {*range(14, 20), *range(21, 27), 78, 79, 80}


def test_of_many_passes_the_two_nearest_others_are_compared() -> None:
    passes = np.concatenate([[[0.1 * (i if k % 2 == 0 else 49 - i), 1.5 * k] for i in range(50)] for k in range(5)])
    others = {photo // 50 for photo in compared(passes, 125)} - {2}
    assert others == {1, 3}


def test_in_a_single_ring_only_the_nearest_are_compared_also_where_it_closes() -> None:
    angles = np.radians(6.0 * np.arange(60))
    ring = np.column_stack([np.cos(angles), np.sin(angles)])
    assert compared(ring, 0, most=0.7) == {*range(1, 7), *range(54, 60)}


def test_photos_that_must_not_be_compared_are_in_no_pair() -> None:
    row, near = near_photos(np.full((3, 5), np.inf))
    assert len(row) == len(near) == 0


def test_few_photos_are_all_compared() -> None:
    assert compared(np.array([[0.0, 0.0], [1.0, 0.0]]), 0) == {1}
