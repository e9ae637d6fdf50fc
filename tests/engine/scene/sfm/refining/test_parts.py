"""Parts of a model that hardly any point joins."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.job import Copy, Job
from fruitlangs.engine.scene.sfm.refining.parts import keep_consistent, keep_largest_part
from fruitlangs.engine.scene.sfm.views import PlacedPhoto, model_of

from .test_refinement import with_points


def job_of(model: Any) -> Job:
    """A job with the photos of a model."""
    size = {"width": 80, "height": 80, "copy_width": 80, "copy_height": 80}
    photos = [Copy(name=image.name, copy=image.name, focal=0.0, **size) for image in model.images.values()]
    return Job(folder="/x", photos=photos, config=PhotosConfig(), threads=1)


def chain(shared: list[int]) -> Any:
    """A model of photos of which each shares so many points with the next one."""
    return photos([colmap_library().Rigid3d()] * (len(shared) + 1), shared)


def ring(shared: list[int], beyond: list[int] | None = None) -> Any:
    """A model of photos around a tree, each of which shares so many points with the next one, and with the one after
    that."""
    pycolmap = colmap_library()
    turns = [pycolmap.Rotation3d(np.array([0.0, 2.0 * np.pi * k / len(shared), 0.0])) for k in range(len(shared))]
    tree = np.array([0.0, 0.0, 5.0])
    return photos([pycolmap.Rigid3d(turn, tree - turn.matrix() @ tree) for turn in turns], shared, beyond=beyond)


def photos(
    poses: list[Any], shared: list[int], angles: list[float] | None = None, *, beyond: list[int] | None = None
) -> Any:
    """A model of photos; shared, beyond: points of each with the next one, and with the one after that; angles: in
    degrees, where the shared points are, seen from the middle."""
    pycolmap = colmap_library()
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 90.0, 80, 80)
    pixels = np.random.default_rng(0).uniform(0.0, 80.0, (1000, 2))
    model = model_of(
        PlacedPhoto(number, f"{number:02d}", camera, pose, pixels) for number, pose in enumerate(poses, start=1)
    )
    for step, counts in ((1, shared), (2, beyond or [])):
        for first, count in enumerate(counts):
            for index in range(250 * (step - 1), 250 * (step - 1) + count):
                track = pycolmap.Track()
                track.add_element(first + 1, 500 + index)
                track.add_element((first + step) % len(poses) + 1, index)
                angle = np.radians(angles[first] if angles else 0.0)
                model.add_point3D(5.0 * np.array([np.sin(angle), 0.0, np.cos(angle)]), track)
    return model


@pytest.mark.parametrize(
    ("shared", "kept"),
    [
        ([100, 100, 100, 100], [1, 2, 3, 4, 5]),
        ([100, 100, 100, 9, 100, 100], [1, 2, 3, 4]),
        ([100, 100, 14, 100, 100, 100], [4, 5, 6, 7]),
        ([100, 100, 100, 40, 100, 100], [1, 2, 3, 4, 5, 6, 7]),
        ([100, 100, 100, 20], [1, 2, 3, 4, 5]),
        ([100, 100, 100, 100, 20, 12], [1, 2, 3, 4, 5, 6]),
        ([20, 20, 20, 7], [1, 2, 3, 4]),
    ],
)
def test_photos_that_show_few_of_the_predicted_points_are_taken_out(shared: list[int], kept: list[int]) -> None:
    model = chain(shared)
    assert sorted(keep_largest_part(job_of(model), model).reg_image_ids()) == kept
    assert model.num_reg_images() == len(shared) + 1


@pytest.mark.parametrize(("between", "kept"), [(12, 4), (16, 8)])
def test_photos_that_overlap_little_need_enough_points_to_hold_together(between: int, kept: int) -> None:
    pycolmap = colmap_library()
    turned = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, -np.radians(40.0), 0.0])), np.zeros(3))
    poses = [pycolmap.Rigid3d()] * 4 + [turned] * 4
    model = photos(poses, [200] * 3 + [between] + [200] * 3, angles=[0.0] * 3 + [20.0] + [40.0] * 3)
    assert keep_largest_part(job_of(model), model).num_reg_images() == kept


@pytest.mark.parametrize("shared", [[0, 0, 0], [100, 0, 100]])
def test_no_photo_is_taken_out_if_fewer_than_three_would_remain(shared: list[int]) -> None:
    model = chain(shared)
    assert keep_largest_part(job_of(model), model).num_reg_images() == 4


def test_photos_that_hardly_any_point_holds_are_left_out_but_not_all() -> None:
    model = with_points(np.zeros((0, 3)), [])
    assert keep_largest_part(job_of(model), model).num_reg_images() == 4  # too few would remain
    model = with_points(np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)), [4] * 50)
    for number in sorted(model.points3D)[7:]:
        loose = [each for each in model.points3D[number].track.elements if each.image_id == 2]
        model.delete_observation(2, loose[0].point2D_idx)
    assert model.images[2].num_points3D == 7
    assert sorted(keep_largest_part(job_of(model), model).reg_image_ids()) == [1, 3, 4]


def test_a_ring_whose_ends_do_not_meet_is_cut_at_its_weakest_link() -> None:
    shared = [100] * 36
    shared[35], shared[7] = 30, 60  # its ends are photos 36 and 1; photos 1 to 8 hang on photo 9
    model = ring(shared)
    assert sorted(keep_consistent(job_of(model), model).reg_image_ids()) == list(range(9, 37))
    assert model.num_reg_images() == 36


@pytest.mark.parametrize("changed", [{}, {35: 70}, {20: 30, 21: 30}])
def test_a_ring_that_is_closed_stays_whole_and_so_does_a_blurred_photo(changed: dict[int, int]) -> None:
    model = ring([changed.get(photo, 100) for photo in range(36)])
    assert keep_consistent(job_of(model), model).num_reg_images() == 36


@pytest.mark.parametrize(("between", "kept"), [(100, 56), (30, 45)])
def test_two_photos_that_share_little_contradict_each_other_unless_others_join_them(between: int, kept: int) -> None:
    """Photos 11 and 13 share little; 12 and 13 much, or little too: then the ring is cut between 23 and 24."""
    shared, beyond = [100] * 56, [60] * 56
    beyond[10], shared[22] = 10, 90
    shared[11] = beyond[11] = between
    model = ring(shared, beyond)
    assert keep_consistent(job_of(model), model).num_reg_images() == kept


def test_a_ring_stays_whole_if_less_than_half_of_it_would_remain() -> None:
    model = ring([100 if photo % 4 else 30 for photo in range(36)])
    assert keep_consistent(job_of(model), model).num_reg_images() == 36
