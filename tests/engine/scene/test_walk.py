"""A walk along a row is cut where the photos look, and photos around one tree are not cut."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from fruitlangs.engine.errors import ConfigError
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene, look_along
from fruitlangs.engine.scene.walk import Walk, cut_walk

FloatArray = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
LENS = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])
SPACING = 2.0
"""Metres between two trees; a photo taken two metres away shows two metres."""


def scene_of(places: FloatArray, targets: FloatArray, points: FloatArray) -> Scene:
    """Cameras at places (V, 3) that look at targets (V, 3)."""
    poses = [look_along(place, target - place, UP) for place, target in zip(places, targets, strict=True)]
    photos = [ArrayPhoto(f"{view:03d}.png", np.zeros((80, 100, 3), np.uint8)) for view in range(len(poses))]
    cameras = [Camera(LENS, pose, 100, 80) for pose in poses]
    return Scene(cameras, photos, points, np.zeros((len(points), 3), np.uint8), UP)


def row_of_trees(trees: int) -> FloatArray:
    """Points of crowns half a metre wide along x."""
    random = np.random.default_rng(1)
    return np.concatenate([random.normal([SPACING * tree, 0.0, 1.0], 0.2, (300, 3)) for tree in range(trees)])


def walk_along(trees: int, views: int, *, both: bool = False) -> Scene:
    """A walk past the trees; there on one side, and back on the other if `both`."""
    along = np.linspace(-0.5, SPACING * (trees - 1) + 0.5, views)
    side = np.full(views, -2.0)
    if both:
        along, side = np.concatenate([along, along[::-1]]), np.concatenate([side, -side])
    targets = np.stack([along, 0.0 * along, 0.0 * along + 1.0], axis=1)
    return scene_of(targets + side[:, None] * [0.0, 1.0, 0.0], targets, row_of_trees(trees))


def require(walk: Walk | None) -> Walk:
    assert walk is not None
    return walk


def test_sections_have_equally_many_photos_and_borders_between_trees() -> None:
    scene = walk_along(9, 90)
    walk = require(cut_walk(scene, photos=30))
    assert len(walk.sections) == 3
    np.testing.assert_allclose(np.abs(walk.axis), [1.0, 0.0, 0.0], atol=1e-9)
    assert np.bincount(walk.owners).tolist() == pytest.approx([30, 30, 30], abs=6)
    trees = np.array([section.low for section in walk.sections[1:]]) / SPACING
    assert np.abs(trees - np.floor(trees) - 0.5).max() < 0.3


def test_every_photo_that_shows_the_border_of_a_cell_belongs_to_both_sections() -> None:
    scene = walk_along(9, 90)
    walk = require(cut_walk(scene, photos=30))
    border = np.array([walk.sections[1].low, 0.0, 1.0]) * np.sign(walk.axis[0])
    showing = {view for view, camera in enumerate(scene.cameras) if camera.find_in_frame(border[None])[0][0]}
    for section in walk.sections[:2]:
        assert showing <= set(section.photos.tolist())


def test_every_point_and_every_photo_belongs_to_one_section() -> None:
    walk = require(cut_walk(walk_along(9, 90), photos=30))
    places = np.random.default_rng(2).uniform(-100.0, 100.0, (1000, 3))
    cells = walk.cells(places)
    for number, section in enumerate(walk.sections):
        along = places[cells == number] @ walk.axis
        assert (along >= section.low).all()
        assert (along < section.high).all()
        assert set(np.flatnonzero(walk.owners == number)) <= set(section.photos.tolist())


def test_sections_follow_the_way_of_the_walk() -> None:
    scene = walk_along(9, 90)
    back = Scene(scene.cameras[::-1], scene.images, scene.points, scene.colors, UP)
    there, again = require(cut_walk(scene, photos=30)), require(cut_walk(back, photos=30))
    assert there.axis[0] > 0.0 > again.axis[0]
    assert 0 in there.sections[0].photos
    assert 0 in again.sections[0].photos


def test_both_sides_of_a_tree_are_in_one_section() -> None:
    scene = walk_along(9, 45, both=True)
    walk = require(cut_walk(scene, photos=30))
    for section in walk.sections:
        sides = {camera.center[1] > 0.0 for camera in (scene.cameras[view] for view in section.photos)}
        assert sides == {True, False}


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_photos_around_one_tree_are_not_cut_however_many_there_are(share: float) -> None:
    turns = 2 * np.pi * share * np.arange(400) / 400
    places = np.stack([2.5 * np.cos(turns), 2.5 * np.sin(turns), 0.0 * turns + 1.2], axis=1)
    assert cut_walk(scene_of(places, np.tile([0.0, 0.0, 1.0], (400, 1)), row_of_trees(1)), photos=30) is None


def test_few_photos_are_not_cut_unless_it_is_asked_for() -> None:
    scene = walk_along(9, 60)
    assert cut_walk(scene, photos=70) is None
    assert len(require(cut_walk(scene, photos=70, sections=3)).sections) == 3
    assert cut_walk(scene, photos=10, sections=1) is None


def test_a_cell_is_not_shorter_than_a_photo_is_wide() -> None:
    walk = require(cut_walk(walk_along(4, 400), photos=10))
    assert len(walk.sections) <= 3


def test_more_sections_than_there_are_is_an_error_that_names_what_fits() -> None:
    with pytest.raises(ConfigError, match=r"--scene.sections is 50.* at most 8"):
        cut_walk(walk_along(9, 90), photos=30, sections=50)


def test_no_section_is_empty_where_many_photos_were_taken_at_one_place() -> None:
    along = np.concatenate([np.linspace(-0.5, 16.5, 30), np.full(200, 3.0)])
    targets = np.stack([along, 0.0 * along, 0.0 * along + 1.0], axis=1)
    walk = require(cut_walk(scene_of(targets - [0.0, 2.0, 0.0], targets, row_of_trees(9)), photos=30))
    assert np.bincount(walk.owners, minlength=len(walk.sections)).min() >= 4
    lows = [section.low for section in walk.sections]
    assert lows == sorted(lows)


def test_a_scene_without_points_is_not_cut() -> None:
    scene = walk_along(9, 90)
    assert cut_walk(Scene(scene.cameras, scene.images, np.zeros((0, 3)), scene.colors[:0], UP), photos=30) is None
