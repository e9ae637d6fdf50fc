"""Places photos that no verified pair joins with the others, on the points of these.

Two photos that show leaves from near by, a few degrees apart, may share so few features among wrong matches that no
epipolar geometry is found. Points tell more: three of them determine a pose, so that far fewer matches need be right.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..pycolmap_import import colmap_library
from .features import Features, image_ids
from .job import Job
from .matching import match
from .pairs import first_pairs
from .retrieval import similarities

_LEAST_INLIERS = 12
"""Features that must show a point where it is: chance gives up to 8 of 500."""
_ERROR = 6.0
"""Largest distance in pixels of a point from its feature."""
_TRIALS = 20_000
"""Trials of RANSAC: a tenth of the matches may be right."""


def resected(job: Job, features: Sequence[Features], model: Any) -> Any:
    """The model, without points, with those of its missing photos that its points determine; None if it has none.

    model: its points are of features, in the order of `features`.
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
    seen = {position: _seen(model, images[position].image_id) for position in poses}
    found = {}
    for missing, near in _candidates(job, features, set(poses)):
        pose = _pose(model, features, seen, cameras[missing], missing, near, job.config.seed)
        if pose is not None:
            found[missing] = pose
    return _with_poses(images, cameras, poses | found) if found else None


def _candidates(job: Job, features: Sequence[Features], placed: set[int]) -> Iterator[tuple[int, list[int]]]:
    """Each missing photo, with the placed ones that may show the same."""
    count = len(features)
    similarity = similarities(features, job.config.seed) if count > job.config.exhaustive_up_to else None
    near: dict[int, list[int]] = {missing: [] for missing in range(count) if missing not in placed}
    for i, j in first_pairs(similarity, count, job.config):
        for missing, other in ((i, j), (j, i)):
            if missing in near and other in placed:
                near[missing].append(other)
    yield from near.items()


def _seen(model: Any, image: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The features of a photo that show a point, and the numbers of these points."""
    points = {k: feature.point3D_id for k, feature in enumerate(model.images[image].points2D) if feature.has_point3D()}
    return np.array(list(points), np.int64), np.array(list(points.values()), np.int64)


def _pose(
    model: Any,
    features: Sequence[Features],
    seen: Mapping[int, tuple[NDArray[np.int64], NDArray[np.int64]]],
    camera: Any,
    missing: int,
    near: Sequence[int],
    seed: int,
) -> Any:
    """The pose of a photo from its matches with points that others see; None if they determine none."""
    pycolmap = colmap_library()
    matched = [np.zeros((0, 2), np.int64)]
    for other in near:
        feature, point = seen[other]
        matches = match(features[other].select(feature), features[missing])
        matched.append(np.column_stack([matches[:, 1], point[matches[:, 0]]]))
    pairs = np.unique(np.concatenate(matched), axis=0)
    pixels = features[missing].positions[pairs[:, 0]].astype(np.float64)
    places = np.array([model.points3D[int(number)].xyz for number in pairs[:, 1]]).reshape(-1, 3)
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _ERROR
    options.ransac.max_num_trials = options.ransac.min_num_trials = _TRIALS
    options.ransac.random_seed = seed
    found = pycolmap.estimate_and_refine_absolute_pose(pixels, places, camera, options)
    if found is None or len(np.unique(pairs[found["inlier_mask"], 0])) < _LEAST_INLIERS:
        return None
    return found["cam_from_world"]


def _with_poses(images: Sequence[Any], cameras: Sequence[Any], poses: Mapping[int, Any]) -> Any:
    """A model of photos at these poses, without points: the refinement finds them again."""
    pycolmap = colmap_library()
    model = pycolmap.Reconstruction()
    for position in sorted(poses):
        image, camera = images[position], cameras[position]
        if camera.camera_id not in model.cameras:
            model.add_camera_with_trivial_rig(camera)
        copy = pycolmap.Image(
            name=image.name, keypoints=np.zeros((0, 2)), camera_id=camera.camera_id, image_id=image.image_id
        )
        model.add_image_with_trivial_frame(copy, poses[position])
    return model
