"""What photos show of a prompt for which no fruit was counted."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from simulated_fruit import look_at

from fruitlangs.engine.counting.accounts.photo_regions import LEAST_PHOTOS, PhotoRegions
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap
from fruitlangs.engine.scene.camera import Camera

DIAMETER = 0.4
FRUIT = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5]])


def ring(views: int) -> list[Camera]:
    turns = np.arange(views) * 2 * np.pi / views
    return [look_at(np.array([6.0 * np.cos(turn), 6.0 * np.sin(turn), 0.6]), np.zeros(3)) for turn in turns]


def discs(
    camera: Camera, balls: NDArray, diameter: float = DIAMETER, *, shrink: int = 1, probability: float = 0.8
) -> PhotoMap:
    """A map of the photo, `shrink` times smaller, in which balls (B, 3) are discs."""
    height, width = camera.height // shrink, camera.width // shrink
    v, u = (np.mgrid[:height, :width] + 0.5) * shrink
    drawn = np.zeros((height, width), np.float32)
    for (x, y), depth in zip(*camera.project(balls), strict=True):
        drawn[np.hypot(u - x, v - y) <= 0.5 * diameter * camera.K[0, 0] / depth] = probability
    return PhotoMap(drawn, np.zeros((height, width, 2), np.float32))


def nothing(camera: Camera) -> PhotoMap:
    return discs(camera, np.zeros((0, 3)))


def surface(balls: NDArray = FRUIT, diameter: float = DIAMETER) -> NDArray:
    """Positions on the balls."""
    out = np.random.default_rng(0).normal(size=(200, 3))
    out *= 0.5 * diameter / np.linalg.norm(out, axis=1, keepdims=True)
    return (balls[:, None] + out).reshape(-1, 3)


@pytest.mark.parametrize("shrink", [1, 3])
def test_places_that_several_photos_show_are_counted_once_each(shrink: int) -> None:
    cameras = ring(8)
    regions = PhotoRegions.of([discs(camera, FRUIT, shrink=shrink) for camera in cameras], cameras, 0.5)
    assert regions.count_places(surface(), DIAMETER * 1.1) == 3
    assert regions.probability == pytest.approx(0.8)
    assert regions.width == pytest.approx(DIAMETER * 300.0 / 6.0, rel=0.2)


@pytest.mark.parametrize(("photos", "places"), [(LEAST_PHOTOS - 1, 0), (LEAST_PHOTOS, 1)])
def test_a_place_needs_three_photos(photos: int, places: int) -> None:
    cameras = ring(12)
    maps = [discs(camera, FRUIT[:1]) if view < photos else nothing(camera) for view, camera in enumerate(cameras)]
    regions = PhotoRegions.of(maps, cameras, 0.5)
    assert regions.count_places(surface(), 1.1 * DIAMETER) == places
    assert regions.at_once == places


def test_a_place_needs_a_tenth_of_the_photos_that_frame_it() -> None:
    cameras = ring(40)
    maps = [discs(camera, FRUIT[:1]) if view < 3 else nothing(camera) for view, camera in enumerate(cameras)]
    assert PhotoRegions.of(maps, cameras, 0.5).count_places(surface(), 1.1 * DIAMETER) == 0


def test_one_large_object_is_one_place_and_not_as_many_as_fruit_would_fit() -> None:
    cameras, ball = ring(8), np.zeros((1, 3))
    regions = PhotoRegions.of([discs(camera, ball, 2.0) for camera in cameras], cameras, 0.5)
    on_ball = surface(ball, 2.0)
    assert regions.count_places(on_ball, 0.1) <= 3
    assert regions.count_places(on_ball, None) <= 3
    assert regions.at_once == 1


def test_what_is_below_the_threshold_or_a_few_pixels_is_nothing() -> None:
    cameras = ring(8)
    faint = PhotoRegions.of([discs(camera, FRUIT, probability=0.45) for camera in cameras], cameras, 0.5)
    tiny = PhotoRegions.of([discs(camera, FRUIT, 0.02) for camera in cameras], cameras, 0.5)
    for regions in (faint, tiny):
        assert (regions.count_places(surface(), DIAMETER), regions.at_once) == (0, 0)
        assert np.isnan(regions.probability)


def test_regions_at_once_are_those_of_the_third_fullest_photo() -> None:
    cameras = ring(5)
    maps = [discs(camera, FRUIT[:number]) for camera, number in zip(cameras, (3, 0, 2, 1, 3), strict=True)]
    assert PhotoRegions.of(maps, cameras, 0.5).at_once == 2
    assert PhotoRegions.of(maps[:2], cameras[:2], 0.5).at_once == 0


def test_positions_behind_a_camera_are_shown_by_none() -> None:
    cameras = ring(8)
    regions = PhotoRegions.of([discs(camera, FRUIT) for camera in cameras], cameras, 0.5)
    assert regions.count_places(np.full((5, 3), 50.0), DIAMETER) == 0
    assert regions.count_places(np.zeros((0, 3)), DIAMETER) == 0
