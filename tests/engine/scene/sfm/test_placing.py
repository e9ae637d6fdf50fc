"""Photos that lie at a wrong place are placed again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.scene.alignment import align
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.job import Job
from fruitlangs.engine.scene.sfm.placing import register_again


def scene(folder: Path) -> tuple[Job, Any]:
    """A job whose database holds the matches of a model, and the model."""
    pycolmap = colmap_library()
    pycolmap.set_random_seed(0)
    (folder / "copies").mkdir()
    job = Job(folder=str(folder), photos=[], config=PhotosConfig(), threads=1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, 10, 300
    database = job.open_database()
    model = pycolmap.synthesize_dataset(options, database)
    database.close()
    return job, model


@pytest.mark.parametrize("fixed", [True, False])
def test_a_photo_at_a_wrong_place_returns(fixed: bool, tmp_path: Path) -> None:
    job, model = scene(tmp_path)
    wrong = pycolmap_copy(model)
    pose = wrong.images[4].cam_from_world()
    frame = wrong.frame(wrong.images[4].frame_id)
    frame.rig_from_world = colmap_library().Rigid3d(pose.rotation, pose.translation + [2.0, 0.0, 1.0])
    again = register_again(job, wrong, {4}, fixed=fixed)
    assert again.num_reg_images() == 10
    assert distances(again, model).max() < 1e-3
    if fixed:
        for i in set(model.images) - {4}:
            assert np.allclose(again.images[i].projection_center(), model.images[i].projection_center(), atol=1e-9)


def test_a_photo_that_matches_nothing_stays_out(tmp_path: Path) -> None:
    job, model = scene(tmp_path)
    without_pairs(job, 4)
    again = register_again(job, model, {4}, fixed=True)
    assert again is None or not again.images[4].has_pose


@pytest.mark.parametrize("fixed", [True, False])
def test_a_photo_without_pairs_keeps_its_place_while_others_are_placed_again(fixed: bool, tmp_path: Path) -> None:
    job, model = scene(tmp_path)
    without_pairs(job, 7)
    again = register_again(job, model, {4}, fixed=fixed)
    assert again.num_reg_images() == 10
    assert distances(again, model).max() < 1e-3


def without_pairs(job: Job, photo: int) -> None:
    database = job.open_database()
    for image in range(1, 11):
        if image != photo:
            database.delete_two_view_geometry(min(image, photo), max(image, photo))
            database.delete_matches(min(image, photo), max(image, photo))
    database.close()


def pycolmap_copy(model: Any) -> Any:
    return colmap_library().Reconstruction(model)


def distances(one: Any, other: Any) -> np.ndarray:
    """Distances between the cameras of two models, after the best similarity."""
    numbers = sorted(other.images)
    own, theirs = (np.array([model.images[i].projection_center() for i in numbers]) for model in (one, other))
    return np.linalg.norm(align(own, theirs).apply(own) - theirs, axis=1)
