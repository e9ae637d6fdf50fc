"""Models of the same photos are joined where they share photos."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.joining import LEAST_SHARED, join_models
from fruitlangs.engine.scene.sfm.views import PlacedPhoto, deregister_photos, model_of


def whole() -> Any:
    colmap_library().set_random_seed(0)
    options = colmap_library().SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 12, 50
    return colmap_library().synthesize_dataset(options)


def elsewhere(model: Any) -> Any:
    """The model in another frame: larger, turned and shifted."""
    pycolmap = colmap_library()
    turn = pycolmap.Rotation3d(np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    model.transform(pycolmap.Sim3d(2.5, turn, np.array([1.0, 2.0, 3.0])))
    return model


def split(shared: int) -> tuple[Any, Any, Any]:
    """A model, its first photos with `shared` more, and its last photos in another frame."""
    model = whole()
    order = sorted(model.reg_image_ids())
    return (
        model,
        deregister_photos(model, set(order[6 + shared :])),
        elsewhere(deregister_photos(model, set(order[:6]))),
    )


def test_photos_of_two_models_that_share_some_get_the_places_of_the_whole() -> None:
    model, one, other = split(LEAST_SHARED)
    (both,) = join_models([other, one])
    assert both.num_reg_images() == 12
    assert {image.name for image in both.images.values()} == {image.name for image in model.images.values()}
    larger = one  # its frame is kept
    for image in model.reg_image_ids():
        pose, true = both.images[image].cam_from_world(), model.images[image].cam_from_world()
        np.testing.assert_allclose(pose.matrix(), true.matrix(), atol=1e-6)
    assert larger.num_reg_images() > other.num_reg_images()


@pytest.mark.parametrize("shared", [0, LEAST_SHARED - 1])
def test_models_that_share_too_few_photos_stay_apart(shared: int) -> None:
    _, one, other = split(shared)
    assert [each.num_reg_images() for each in join_models([one, other])] == sorted([6 + shared, 6], reverse=True)


def test_models_whose_shared_photos_do_not_agree_stay_apart() -> None:
    _, one, other = split(LEAST_SHARED)
    for number, frame in enumerate(sorted(other.reg_frame_ids())):
        pose = other.frame(frame).rig_from_world
        shift = np.random.default_rng(number).normal(0.0, 5.0, 3)
        other.frame(frame).rig_from_world = colmap_library().Rigid3d(pose.rotation, pose.translation + shift)
    assert len(join_models([one, other])) == 2


def test_a_model_that_shares_photos_only_with_a_smaller_one_is_joined_through_it() -> None:
    pycolmap, places = colmap_library(), np.random.default_rng(0).normal(size=(40, 3))
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=100, height=100, params=[100, 50, 50, 0], camera_id=1)

    def of(photos: list[int], scale: float) -> Any:
        poses = {i: pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), -scale * places[i]) for i in photos}
        return model_of(PlacedPhoto(i, f"{i:06d}.png", camera, pose, np.zeros((0, 2))) for i, pose in poses.items())

    first, last, between = of([*range(1, 13)], 1.0), of([*range(16, 26)], 2.0), of([9, 10, 11, 12, 16, 17, 18, 19], 3.0)
    assert [each.num_reg_images() for each in join_models([first, last, between])] == [22]
