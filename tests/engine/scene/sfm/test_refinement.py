"""Refined cameras: which photos are matched again, and which points are kept."""

from __future__ import annotations

import types
from typing import Any, cast

import numpy as np
import pytest

from fruitlangs.engine.progress import silent
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm import refinement
from fruitlangs.engine.scene.sfm.features import Features
from fruitlangs.engine.scene.sfm.job import Job
from fruitlangs.engine.scene.sfm.refinement import held, most_seen, near_pairs, on_surfaces, same_places, starts
from fruitlangs.engine.scene.sfm.views import PlacedPhoto, model_of


def placed(degrees: float) -> types.SimpleNamespace:
    """A photo on a circle around the origin that looks at it."""
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]])
    pose = colmap_library().Rigid3d(colmap_library().Rotation3d(turn), np.array([0.0, 0.0, 4.0]))
    return types.SimpleNamespace(cam_from_world=lambda: pose, projection_center=lambda: -turn.T @ [0.0, 0.0, 4.0])


def test_photos_are_matched_again_with_similar_views_only() -> None:
    pairs = near_pairs({position: placed(20.0 * position) for position in range(18)})
    assert {(i, i + 1) for i in range(17)} <= set(pairs)
    assert all(min(j - i, 18 - j + i) <= 2 for i, j in pairs)


def with_points(places: np.ndarray, lengths: list[int]) -> Any:
    """A model with points at the places, seen by so many photos."""
    colmap_library().set_random_seed(0)
    options = colmap_library().SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 4, 200
    model = colmap_library().synthesize_dataset(options)
    numbers = sorted(model.points3D)
    for number, place, length in zip(numbers, places, lengths, strict=False):
        model.point3D(number).xyz = place
        while model.point3D(number).track.length() > length:
            element = model.point3D(number).track.elements[0]
            model.delete_observation(element.image_id, element.point2D_idx)
    for number in numbers[len(places) :]:
        model.delete_point3D(number)
    return model


def test_points_of_two_photos_are_kept_near_points_of_three_only() -> None:
    surface = np.column_stack([*(axis.ravel() for axis in np.mgrid[0:10.0, 0:10.0]), np.zeros(100)])
    near, far = surface[:5] + [0.5, 0.5, 0.5], surface[:5] + [0.0, 0.0, 30.0]
    model = with_points(np.concatenate([surface, near, far]), [3] * 100 + [2] * 10)
    assert model.num_points3D() == 110
    kept = on_surfaces(model)
    assert kept.num_points3D() == 105
    assert max(point.xyz[2] for point in kept.points3D.values()) < 1.0


def test_points_that_adjust_cameras_reach_the_edges_of_the_photos() -> None:
    middle = [(30.0 + column, 30.0 + row) for column in range(20) for row in range(20)]
    edge = [(float(x), y) for x in range(5, 80, 10) for y in (5.0, 75.0)]
    camera = colmap_library().Camera.create_from_model_name(1, "SIMPLE_RADIAL", 90.0, 80, 80)
    pixels = np.array(middle + edge)
    photos = [PlacedPhoto(number, f"{number}", camera, colmap_library().Rigid3d(), pixels) for number in range(1, 5)]
    model = model_of(photos)
    for index in range(len(pixels)):
        track = colmap_library().Track()
        for photo in photos[: 4 if index < len(middle) else 3]:
            track.add_element(photo.number, index)
        model.add_point3D(np.zeros(3), track)
    kept = most_seen(model, 128)
    assert kept.num_points3D() == len(edge) + 2 * 4  # two in each of the four parts of the middle
    assert sum(point.track.length() == 3 for point in kept.points3D.values()) == len(edge)


def test_photos_that_hardly_any_point_holds_are_left_out_but_not_all() -> None:
    model = with_points(np.zeros((0, 3)), [])
    assert held(model).num_reg_images() == 4  # too few would remain
    model = with_points(np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)), [4] * 50)
    for number in sorted(model.points3D)[7:]:
        loose = [each for each in model.points3D[number].track.elements if each.image_id == 2]
        model.delete_observation(2, loose[0].point2D_idx)
    assert model.images[2].num_points3D == 7
    assert sorted(held(model).reg_image_ids()) == [1, 3, 4]


def test_photos_are_at_the_same_places_if_none_is_missing_or_has_moved_far() -> None:
    before = with_points(np.zeros((1, 3)), [4])
    centers = np.array([image.projection_center() for image in before.images.values()])
    extent = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))

    def moved(share: float) -> Any:
        after = colmap_library().Reconstruction(before)
        pose = after.images[2].cam_from_world()
        translation = pose.translation + [share * extent, 0.0, 0.0]
        frame = after.frame(after.images[2].frame_id)
        frame.rig_from_world = colmap_library().Rigid3d(pose.rotation, translation)
        return after

    assert same_places(before, moved(0.04), {2})
    assert not same_places(before, moved(0.06), {2})
    assert same_places(before, moved(0.06), {1})
    without = moved(0.0)
    without.deregister_frame(without.images[3].frame_id)
    assert not same_places(before, without, {2})


@pytest.mark.parametrize("kept", [True, False])
def test_placing_photos_again_never_loses_those_that_points_placed(kept: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    model = with_points(np.zeros((1, 3)), [4])
    again = colmap_library().Reconstruction(model)
    again.deregister_frame(again.images[3 if kept else 2].frame_id)
    monkeypatch.setattr(refinement, "place_again", lambda *_, **__: again)
    found = list(starts(cast(Job, None), model, settled={2, 9}, unsure={3, 5}))
    assert [each.num_reg_images() for each in found] == ([3, 3] if kept else [4])


def test_photos_that_placing_again_does_not_move_are_not_placed_again_in_later_rounds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, calls, settled = with_points(np.zeros((1, 3)), [4]), [], set[int]()
    monkeypatch.setattr(refinement, "_unsure", lambda *_: {3, 5})
    monkeypatch.setattr(refinement, "place_again", lambda *_, fixed: calls.append(fixed))
    for _ in range(3):
        again = refinement._improved(cast(Job, None), model, settled, lambda start, _: start, silent)
        assert again is model
    assert calls == [True, False]
    assert settled == {3, 5}


@pytest.mark.parametrize(("photos", "count"), [(10, 5000), (200, 3250), (1000, 2048)])
def test_the_more_photos_the_fewer_features_of_each_become_points(
    photos: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes = np.arange(5000, dtype=np.float32)
    features = [Features(np.zeros((5000, 2), np.float32), sizes, np.zeros((5000, 128), np.uint8))] * photos
    monkeypatch.setattr(refinement, "_matched", lambda _, __, chosen, *___: chosen)
    chosen = refinement._matched_all(cast(Job, None), features, None, silent)
    assert len(chosen) == photos
    assert all(np.array_equal(each, np.arange(5000 - count, 5000)) for each in chosen)
