"""What views show of spheres."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from fruitlangs.engine.counting.evidence.visibility import Picture
from fruitlangs.engine.counting.photos.places import NO_PLACES, Places
from fruitlangs.engine.counting.photos.verifier import KNOWN_REACH, Network, Verifier, find_known_near
from fruitlangs.engine.counting.photos.view_kernels import DEPTH, DOWN, INSIDE, OTHERS, OWN, PROBABILITY, RIGHT
from fruitlangs.engine.counting.photos.views import PhotoViews, cube_centers, find_occupied_cubes
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap
from fruitlangs.engine.scene.camera import Camera, look_along

BALL, RADIUS, FOCAL = np.zeros(3), 0.1, 200.0
WIDTH, HEIGHT = 80, 60
NOWHERE = np.zeros((0, 3))


def camera_at(turn: float) -> Camera:
    eye = 2.0 * np.array([np.cos(turn), np.sin(turn), 0.0])
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(width=WIDTH, height=HEIGHT, K=K, world_to_camera=look_along(eye, -eye, np.array([0.0, 0.0, 1.0])))


def picture_of(camera: Camera) -> tuple[Picture, PhotoMap]:
    """The rendered depth of a ball before a wall, and the map of a photo that shows it."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    (fx, _, cx), (_, fy, cy), _ = camera.K
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
    a, b, c = (rays**2).sum(-1), -4.0 * rays[..., 2], 4.0 - RADIUS**2
    root = b * b - 4.0 * a * c
    hit = root > 0.0
    depth = np.where(hit, (-b - np.sqrt(np.maximum(root, 0.0))) / (2.0 * a), 5.0)
    shown = hit.astype(np.float32)
    offsets = rays[..., :2] / (RADIUS / 2.0)
    return Picture(camera, depth.astype(np.float32), shown), PhotoMap(shown, offsets.astype(np.float32))


@pytest.fixture(scope="module")
def views() -> PhotoViews:
    pictures, maps = zip(*(picture_of(camera_at(turn)) for turn in np.linspace(0.0, 2.0, 6)), strict=True)
    return PhotoViews.of(pictures, maps)


FLAT = 2.5
"""Pixels of `flat` views are this many times as wide as they are high."""


@pytest.fixture(scope="module")
def flat() -> PhotoViews:
    """The same views in pixels that are not square: fy is FLAT times fx."""
    cameras = [camera_at(turn).resize(WIDTH, round(FLAT * HEIGHT)) for turn in np.linspace(0.0, 2.0, 6)]
    pictures, maps = zip(*map(picture_of, cameras), strict=True)
    return PhotoViews.of(pictures, maps)


def crops_of(views: PhotoViews, others: np.ndarray, near: np.ndarray) -> np.ndarray:
    chosen = np.arange(2)[None]
    radii = np.full(len(others), RADIUS)
    return views.crops(BALL[None], np.array([RADIUS]), chosen, others, radii, near, cells=16, span=2.0)[0]


def test_a_sphere_at_the_ball_scores_highest(views: PhotoViews) -> None:
    places = np.array([BALL, [0.0, 0.0, 0.08], [0.0, 0.1, 0.0], [0.0, 0.0, 0.3], [0.4, 0.0, 0.0]])
    scores = views.score(places, RADIUS)
    assert scores.argmax() == 0
    assert scores[3] < 0.0 < scores[0]  # the views see through the place above the ball


def test_pixels_of_fruit_lead_to_the_centre_of_the_ball(views: PhotoViews) -> None:
    places = views.places(RADIUS, (0.0,), 0.02, np.eye(3, 4))
    assert 0 < len(places) < 20
    assert (np.linalg.norm(places, axis=1) < 0.4 * RADIUS).all()


def test_the_places_of_all_pixels_are_not_in_memory_together() -> None:
    pictures, maps = zip(*[picture_of(camera_at(0.0))] * 200, strict=True)
    views, pushes = PhotoViews.of(pictures, maps), tuple(np.linspace(-0.02, 0.02, 9))
    tracemalloc.start()
    places = views.places(RADIUS, pushes, 0.02, np.eye(3, 4))
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    pixels = 200 * np.count_nonzero(maps[0].probability)
    assert len(places) < 100
    assert most < 0.2 * pixels * len(pushes) * places.itemsize * 3


def test_places_move_with_the_scene() -> None:
    places = np.random.default_rng(0).normal(size=(500, 3))
    moved = places + [3.0, -2.0, 1.0]
    frame = np.concatenate([np.eye(3), [[-3.0], [2.0], [-1.0]]], axis=1)
    expected = cube_centers(find_occupied_cubes(places, 0.3, np.eye(3, 4)), 0.3, np.eye(3, 4)) + [3.0, -2.0, 1.0]
    assert np.allclose(cube_centers(find_occupied_cubes(moved, 0.3, frame), 0.3, frame), expected)


def test_views_that_frame_the_ball_are_chosen(views: PhotoViews) -> None:
    chosen, sums = views.choose(np.array([BALL, [50.0, 0.0, 0.0]]), np.full(2, RADIUS), 4)
    assert (chosen[0] >= 0).all()
    assert sums[0, 4] == pytest.approx(6)
    assert (chosen[1] == -1).all()
    assert (sums[1] == 0).all()


def test_of_many_views_those_that_show_the_ball_are_chosen_best_first(views: PhotoViews) -> None:
    shown = [picture_of(camera_at(turn)) for turn in np.linspace(0.0, 2.0 * np.pi, 6, endpoint=False)]
    empty = [(picture, PhotoMap(np.zeros_like(maps.probability), maps.offsets)) for picture, maps in shown]
    fainter = PhotoMap(shown[2][1].probability * (np.arange(WIDTH) < WIDTH // 2), shown[2][1].offsets)
    order = [empty[0], (shown[2][0], fainter), empty[1], shown[3], empty[2], shown[4]]
    many = PhotoViews.of([picture for picture, _ in order], [maps for _, maps in order])
    chosen, _ = many.choose(BALL[None], np.array([RADIUS]), 4)
    assert sorted(chosen[0, :2].tolist()) == [3, 5]
    assert chosen[0, 2:].tolist() == [1, -1]


@pytest.mark.parametrize(("aside", "chosen"), [(0.5, True), (1.2, False)])
def test_a_view_that_cuts_the_ball_is_chosen_if_it_shows_a_part(aside: float, chosen: bool) -> None:
    picture, shown = picture_of(camera_at(0.0))
    cut = WIDTH // 2 + round(aside * FOCAL * RADIUS / 2.0)  # first column: the middle of the ball lies left of it
    lens = np.array([[FOCAL, 0.0, WIDTH / 2 - cut], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    camera = Camera(width=WIDTH - cut, height=HEIGHT, K=lens, world_to_camera=picture.camera.world_to_camera)
    half = Picture(camera, picture.depth[:, cut:], picture.fruit[:, cut:])
    views = PhotoViews.of([half], [PhotoMap(shown.probability[:, cut:], shown.offsets[:, cut:])])
    views_of_ball, sums = views.choose(BALL[None], np.array([RADIUS]), 1)
    assert (views_of_ball[0, 0] == 0) == chosen
    assert sums[0, 4] < 0.5


def test_a_crop_shows_the_ball_in_its_middle(views: PhotoViews) -> None:
    crop = crops_of(views, NOWHERE, np.full((1, 1), -1))[0]
    assert crop[PROBABILITY, 7:9, 7:9].min() == 1.0
    assert crop[PROBABILITY, 0].max() == 0.0
    assert crop[DEPTH, 8, 8] == pytest.approx(-0.25, abs=0.02)  # one radius nearer, in four radii
    assert (crop[INSIDE] == 1.0).all()
    assert crop[OWN, 5:11, 5:11].min() > 0.9
    assert np.abs(crop[[RIGHT, DOWN]]).max() < 0.05


def test_pixels_of_a_known_fruit_are_not_those_of_its_neighbour(views: PhotoViews) -> None:
    aside = BALL + [0.0, 0.0, 0.5 * RADIUS]
    chosen, radius = np.arange(2)[None], np.array([RADIUS])
    alone, explained = (
        views.crops(aside[None], radius, chosen, others, np.full(len(others), RADIUS), near, cells=16, span=2.0)[0, 0]
        for others, near in ((NOWHERE, np.full((1, 1), -1)), (BALL[None], np.zeros((1, 1), np.int64)))
    )
    assert alone[OWN].max() > 0.3
    assert explained[OWN].max() < 0.5 * alone[OWN].max()
    assert np.array_equal(alone[PROBABILITY], explained[PROBABILITY])


def test_known_fruit_in_front_and_behind_are_told_apart(views: PhotoViews) -> None:
    towards = views.poses[0, :, :3].T @ np.array([0.0, 0.0, 1.0])
    others = np.stack([-2.0 * RADIUS * towards, 2.0 * RADIUS * towards])
    front, behind = (crops_of(views, others, np.array([[index, -1]]))[0, OTHERS] for index in range(2))
    assert front.max() == 1.0
    assert behind.min() == -1.0
    both = crops_of(views, others, np.array([[1, 0]]))[0, OTHERS]
    assert (both[front > 0] == 1.0).all()  # what is in front covers what is behind


def test_slopes_are_the_change_of_pixels(views: PhotoViews) -> None:
    center, chosen, step = np.array([[0.1, -0.05, 0.03]]), np.arange(6)[None], 1e-5
    slopes = views.slopes(center, chosen)
    for axis in range(3):
        moved = center + step * np.eye(3)[axis]
        change = (views.project(moved, chosen)[0] - views.project(center, chosen)[0]) / step
        assert np.allclose(slopes[..., axis], change, rtol=1e-3, atol=1e-2)


def test_crops_are_the_same_in_pixels_that_are_not_square(views: PhotoViews, flat: PhotoViews) -> None:
    others = np.array([[0.0, 0.0, 2.2 * RADIUS]])
    square, stretched = (crops_of(each, others, np.zeros((1, 1), np.int64)) for each in (views, flat))
    assert np.array_equal(square[:, [INSIDE, OTHERS]], stretched[:, [INSIDE, OTHERS]])
    for channel in (PROBABILITY, DEPTH, OWN, RIGHT, DOWN):
        assert np.abs(square[:, channel] - stretched[:, channel]).mean() < 0.02


def test_a_fine_axis_is_sampled_as_finely_as_it_is(views: PhotoViews) -> None:
    """Each cell of a crop covers 2.5 pixels across and 6.25 along."""
    picture, shown = picture_of(camera_at(0.0).resize(WIDTH, round(FLAT * HEIGHT)))
    shown.probability[:] = 0.0
    shown.probability[::4] = 1.0
    crop = crops_of(PhotoViews.of([picture, picture], [shown, shown]), NOWHERE, np.full((1, 1), -1))[0]
    assert 0.1 < crop[PROBABILITY, 4:12].min() <= crop[PROBABILITY, 4:12].max() < 0.6


def test_views_show_the_same_of_a_ball_in_pixels_that_are_not_square(views: PhotoViews, flat: PhotoViews) -> None:
    places, radii = np.array([BALL, [0.0, 0.0, 0.08], [0.0, 0.1, 0.0], [0.0, 0.0, 0.3]]), np.full(4, RADIUS)
    np.testing.assert_allclose(flat.score(places, RADIUS), views.score(places, RADIUS), atol=0.35)
    (square, sums), (stretched, flat_sums) = (each.choose(places, radii, 6) for each in (views, flat))
    assert np.array_equal(np.sort(square, axis=1), np.sort(stretched, axis=1))
    shares = [0, 1, 2, 4]
    np.testing.assert_allclose(flat_sums[:, shares], sums[:, shares], atol=0.35)


@pytest.mark.parametrize(("below", "chosen"), [(0.5, True), (1.2, False)])
def test_a_ball_below_the_edge_is_chosen_by_its_radius_along_this_axis(below: float, chosen: bool) -> None:
    picture, shown = picture_of(camera_at(0.0).resize(WIDTH, round(FLAT * HEIGHT)))
    cut = picture.camera.height // 2 - round(below * FLAT * FOCAL * RADIUS / 2.0)  # rows that are left
    camera = replace(picture.camera, height=cut)
    part = Picture(camera, picture.depth[:cut], picture.fruit[:cut])
    views = PhotoViews.of([part], [PhotoMap(shown.probability[:cut], shown.offsets[:cut])])
    views_of_ball, _ = views.choose(BALL[None], np.array([RADIUS]), 1)
    assert (views_of_ball[0, 0] == 0) == chosen


def test_a_shift_in_radii_moves_a_centre_as_far_in_pixels_that_are_not_square(
    views: PhotoViews, flat: PhotoViews
) -> None:
    shifts, errors = torch.tensor([[[0.3, -0.5]] * 6]), torch.tensor([[-1.0, 0.0, 0.5, -0.5, 0.2, 0.1]])
    moves = [
        Verifier(Network(), each, None)._moves(BALL[None], np.array([RADIUS]), np.arange(6)[None], shifts, errors)  # type: ignore[arg-type]
        for each in (views, flat)
    ]
    np.testing.assert_allclose(moves[1], moves[0], rtol=1e-9)
    assert np.linalg.norm(moves[0]) > 0.2 * RADIUS


def test_a_shift_in_radii_moves_a_small_sphere_less_than_a_large_one(views: PhotoViews) -> None:
    verifier = Verifier(Network(), views, None)  # type: ignore[arg-type]
    shifts, errors = torch.tensor([[[0.3, -0.5]] * 6] * 2), torch.zeros(2, 6)
    both, chosen, radii = np.stack([BALL, BALL]), np.tile(np.arange(6), (2, 1)), np.array([RADIUS, 0.5 * RADIUS])
    lengths = np.linalg.norm(verifier._moves(both, radii, chosen, shifts, errors), axis=1)
    assert lengths[1] == pytest.approx(0.5 * lengths[0])
    far = np.linalg.norm(verifier._moves(both, radii, chosen, 10.0 * shifts, errors), axis=1)
    assert far == pytest.approx(radii)


def test_known_near_leaves_out_far_fruit_and_the_own_one() -> None:
    others = Places(np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]]), np.array([0.2, 0.4, 0.3]))
    near = find_known_near(np.array([[0.1, 0, 0], [1.0, 0, 0]]), others, np.array([-1, 1]))
    assert near[0, :3].tolist() == [0, 1, -1]
    assert near[1, :2].tolist() == [0, -1]
    assert (find_known_near(np.zeros((2, 3)), NO_PLACES) == -1).all()


def test_fruit_are_near_within_a_multiple_of_the_largest_diameter() -> None:
    others = Places(np.array([[0.0, 0.0, 0.0], [50.0, 0.0, 0.0]]), np.array([0.1, 0.5]))
    within, beyond = ([[factor * KNOWN_REACH, 0.0, 0.0]] for factor in (0.99, 1.01))
    assert find_known_near(np.array(within), others)[0, 0] == 0
    assert find_known_near(np.array(beyond), others)[0, 0] == -1
