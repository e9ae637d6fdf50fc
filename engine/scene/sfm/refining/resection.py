"""Places photos that no verified pair joins with the others, on the points of these.

Two photos of leaves near by, taken a few degrees apart, may share so few features that RANSAC finds no epipolar
geometry among the wrong matches. Three points determine a pose, so far fewer correct matches are enough.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...pycolmap_import import colmap_library
from ..features import Features, image_ids
from ..job import Job
from ..matching import match
from ..pairs import Pair
from ..views import PlacedPhoto, model_of

_LEAST_INLIERS, _CHANCE = 12, 1.5
"""Least number of inliers, absolute and relative to what RANSAC finds when the points are shuffled."""
_ERROR = 6.0
"""Largest distance in pixels of a point from its feature."""
_TRIALS = 20_000
"""Trials of RANSAC: enough if a tenth of the matches is correct."""


def resect(job: Job, features: Sequence[Features], pairs: Sequence[Pair], model: Any) -> Any:
    """Return the model, without points, with those of its missing photos that its points determine; None if no missing
    photo can be placed.

    pairs: of photos that may show the same; model: its points are of features, in the order of `features`.
    """
    database = job.open_database()
    try:
        images = [database.read_image(number) for number in image_ids(database, job)]
        cameras = [database.read_camera(image.camera_id) for image in images]
    finally:
        database.close()
    refined = dict(model.cameras.items())
    cameras = [refined.get(camera.camera_id, camera) for camera in cameras]
    poses = {
        position: model.images[image.image_id].cam_from_world()
        for position, image in enumerate(images)
        if image.image_id in model.images and model.images[image.image_id].has_pose
    }
    candidates = _find_candidates(pairs, set(range(len(images))) - set(poses))
    seen = {other: _find_seen(model, images[other].image_id) for other in sorted(set().union(*candidates.values()))}
    found = {}
    for missing, near in candidates.items():
        pose = _estimate_pose(model, features, seen, cameras[missing], missing, near, job.config.seed)
        if pose is not None:
            found[missing] = pose
    if not found:
        return None
    return model_of(
        PlacedPhoto(images[i].image_id, images[i].name, cameras[i], pose, np.zeros((0, 2)))
        for i, pose in (poses | found).items()
    )


def _find_candidates(pairs: Sequence[Pair], missing: Collection[int]) -> dict[int, list[int]]:
    """Find for each missing photo the placed ones that may show the same."""
    near: dict[int, list[int]] = {photo: [] for photo in missing}
    for i, j in pairs:
        for photo, other in ((i, j), (j, i)):
            if photo in near and other not in near:
                near[photo].append(other)
    return near


def _find_seen(model: Any, image: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the features of a photo that show a point, and the numbers of these points."""
    points = {k: feature.point3D_id for k, feature in enumerate(model.images[image].points2D) if feature.has_point3D()}
    return np.array(list(points), np.int64), np.array(list(points.values()), np.int64)


def _estimate_pose(
    model: Any,
    features: Sequence[Features],
    seen: Mapping[int, tuple[NDArray[np.int64], NDArray[np.int64]]],
    camera: Any,
    missing: int,
    near: Sequence[int],
    seed: int,
) -> Any:
    """Estimate the pose of a photo from its matches with points that others see; None if they determine none."""
    matched = [np.zeros((0, 2), np.int64)]
    for other in near:
        feature, point = seen[other]
        matches = match(features[other].select(feature), features[missing])
        matched.append(np.column_stack([matches[:, 1], point[matches[:, 0]]]))
    pairs = np.unique(np.concatenate(matched), axis=0)
    pose, inliers = _resection(model, features[missing], pairs, camera, seed)
    if inliers < _LEAST_INLIERS:
        return None
    shuffled = np.column_stack([pairs[:, 0], np.random.default_rng(seed).permutation(pairs[:, 1])])
    return pose if inliers >= _CHANCE * _resection(model, features[missing], shuffled, camera, seed)[1] else None


def _resection(model: Any, features: Features, pairs: NDArray[np.int64], camera: Any, seed: int) -> tuple[Any, int]:
    """The pose that most pairs (N, 2) of a feature and a point agree with, and how many features and points do."""
    pycolmap = colmap_library()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _ERROR
    options.ransac.max_num_trials = options.ransac.min_num_trials = _TRIALS
    options.ransac.random_seed = seed
    pixels = features.positions[pairs[:, 0]].astype(np.float64)
    places = np.array([model.points3D[int(number)].xyz for number in pairs[:, 1]]).reshape(-1, 3)
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, places, camera, options)
    if found is None:
        return None, 0
    agreeing = pairs[found["inlier_mask"]]
    return found["cam_from_world"], min(len(np.unique(agreeing[:, 0])), len(np.unique(agreeing[:, 1])))
