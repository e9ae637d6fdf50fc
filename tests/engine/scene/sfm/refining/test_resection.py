"""Photos that share too few features with others for an epipolar geometry are placed on the points of these."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.features import Features
from fruitlangs.engine.scene.sfm.job import Copy, Job
from fruitlangs.engine.scene.sfm.pairs import plan_pairs
from fruitlangs.engine.scene.sfm.refining.resection import resect

PHOTOS, POINTS, MISSING = 8, 400, 4


def scene(folder: Path, right: int) -> tuple[Job, list[Features], Any, Any]:
    """A model without one photo, the features of all photos (equal descriptors show the same point), its true pose.

    right: features of the missing photo that have the descriptor of their point; the others have that of another one.
    """
    pycolmap = colmap_library()
    pycolmap.set_random_seed(0)
    (folder / "copies").mkdir()
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 1, PHOTOS, POINTS
    options.num_points2D_without_point3D = 0
    job = Job(folder=str(folder), photos=[], config=PhotosConfig(), threads=1)
    database = job.open_database()
    model = pycolmap.synthesize_dataset(options, database)
    database.close()
    images = sorted(model.images.values(), key=lambda image: image.image_id)
    size = {"width": 100, "height": 100, "copy_width": 100, "copy_height": 100}
    photos = [Copy(name=image.name, copy=image.name, focal=0.0, **size) for image in images]
    job = Job(folder=str(folder), photos=photos, config=PhotosConfig(), threads=1)
    random = np.random.default_rng(0)
    words = random.normal(size=(max(model.points3D) + 1, 128))
    words = np.rint(512 * np.abs(words) / np.linalg.norm(words, axis=1, keepdims=True)).astype(np.uint8)
    features = []
    for position, image in enumerate(images):
        points = np.array([point.point3D_id for point in image.points2D])
        if position == MISSING:
            points[right:] = random.permutation(points[right:])
        pixels = np.array([point.xy for point in image.points2D], np.float32)
        features.append(Features(pixels, np.full(len(pixels), 4.0), words[points]))
    true = images[MISSING].cam_from_world()
    model.deregister_frame(images[MISSING].frame_id)
    return job, features, model, true


def test_a_missing_photo_is_placed_by_a_tenth_of_its_matches(tmp_path: Path) -> None:
    job, features, model, true = scene(tmp_path, right=POINTS // 10)
    before = {image: model.images[image].projection_center() for image in model.reg_image_ids()}
    placed = resect(job, features, plan_pairs(job, features), model)
    assert placed.num_reg_images() == PHOTOS
    for image, center in before.items():
        assert np.allclose(placed.images[image].projection_center(), center)
    pose = placed.images[MISSING + 1].cam_from_world()
    assert np.allclose(pose.matrix(), true.matrix(), atol=0.01)


@pytest.mark.parametrize("right", [0, 5])
def test_chance_places_no_photo(tmp_path: Path, right: int) -> None:
    job, features, model, _ = scene(tmp_path, right)
    assert resect(job, features, plan_pairs(job, features), model) is None


def test_many_wrong_matches_in_a_small_part_of_the_picture_place_no_photo(tmp_path: Path) -> None:
    job, features, model, _ = scene(tmp_path, right=0)
    middle = features[MISSING].positions.mean(0)
    crowded = (middle + 0.1 * (features[MISSING].positions - middle)).astype(np.float32)
    features[MISSING] = Features(crowded, features[MISSING].sizes, features[MISSING].descriptors)
    assert resect(job, features, plan_pairs(job, features), model) is None
