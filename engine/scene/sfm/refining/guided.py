"""Matches of placed photos: features are compared along the epipolar lines that their cameras give."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....progress import Progress
from ...pycolmap_import import colmap_library
from ..features import Features, image_ids
from ..job import Job
from ..matching import match_along_lines
from ..pairs import LARGEST, Pair
from ..placing import triangulate
from .nearness import near_photos

Limits = tuple[float, float]
"""Largest distance in pixels from an epipolar line, and then of a point from its features."""

_ALL = (2.5, 2.0)
"""The limits of the matches of all features."""
_MOST_FEATURES = 650_000
"""Features of all photos together that points are made of in the end: training has room for a tenth as many."""
_LARGEST_ANGLE = 45.0
"""Largest angle between the directions of view of a pair, in degrees: SIFT finds nothing beyond."""


def _database(job: Job) -> Path:
    """The database of the matches along epipolar lines."""
    return job.database.with_name("refined.db")


def make_database(job: Job) -> None:
    """Copy the photos and the places of their features to the database of the refinement."""
    for leftover in _database(job).parent.glob(f"{_database(job).name}*"):
        leftover.unlink()  # SQLite would apply the journal of a killed run to the copy
    shutil.copy(job.database, _database(job))
    with colmap_library().Database.open(_database(job)) as database:
        database.clear_matches()
        database.clear_descriptors()


def match_guided(
    job: Job,
    features: Sequence[Features],
    chosen: Sequence[NDArray[np.int64]],
    model: Any,
    limits: Limits,
    report: Progress,
    near: Set[int] | None = None,
) -> Any:
    """Return the model with the points of the chosen features that match along its epipolar lines; these matches
    replace those in the database. near: only pairs with one of these photos are matched."""
    tolerance, error = limits
    with colmap_library().Database.open(_database(job)) as database:
        numbers = image_ids(database, job)
        database.clear_two_view_geometries()
        placed = {i: model.images[number] for i, number in enumerate(numbers) if has_pose(model, number)}
        straight = {
            i: _undistort(model.cameras[image.camera_id], features[i].select(chosen[i])) for i, image in placed.items()
        }
        pairs = [pair for pair in find_near_pairs(placed) if near is None or not near.isdisjoint(pair)]
        for done, (i, j) in enumerate(pairs):
            report(done / len(pairs), f"matching placed photos: pair {done + 1} of {len(pairs)}")
            geometry = _geometry(model, placed[i], placed[j])
            matches = match_along_lines(geometry.F, straight[i], straight[j], tolerance)
            if matches is not None:
                numbered = np.stack([chosen[i][matches[:, 0]], chosen[j][matches[:, 1]]], axis=1)
                geometry.inlier_matches = numbered.astype(np.uint32)
                database.write_two_view_geometry(numbers[i], numbers[j], geometry)
    return triangulate(job, _database(job), model, error)


def match_all_guided(
    job: Job, features: Sequence[Features], model: Any, report: Progress, near: Set[int] | None = None
) -> Any:
    """Return the model with the points of all features that match along its epipolar lines; of the largest, if photos
    are many. near: as in `match_guided`."""
    count = max(LARGEST, _MOST_FEATURES // len(features))
    return match_guided(job, features, [each.largest(count) for each in features], model, _ALL, report, near)


def has_pose(model: Any, image: int) -> bool:
    """Whether a model has a place for a photo."""
    return image in model.images and model.images[image].has_pose


def find_near_pairs(placed: Mapping[int, Any]) -> list[Pair]:
    """Find the pairs of photos that may show the same: similar directions of view from near places."""
    order = sorted(placed)
    poses = [placed[i].cam_from_world() for i in order]
    views = np.stack([pose.rotation.matrix()[2] for pose in poses])
    centers = np.stack([placed[i].projection_center() for i in order])
    turns = np.degrees(np.arccos(np.clip(views @ views.T, -1.0, 1.0)))
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    extent = max(float(np.median(apart[apart > 0])), 1e-12) if len(order) > 1 else 1.0
    cost = turns + np.degrees(1.0) * apart / extent
    cost[turns > _LARGEST_ANGLE] = np.inf
    np.fill_diagonal(cost, np.inf)
    pairs = {(min(pair), max(pair)) for pair in zip(*(each.tolist() for each in near_photos(cost)), strict=True)}
    return [(order[i], order[j]) for i, j in sorted(pairs)]


def _undistort(camera: Any, features: Features) -> Features:
    """Move the features to the pixels where they would be without distortion of the lens."""
    K = camera.calibration_matrix()
    rays = np.asarray(camera.cam_from_img(features.positions.astype(np.float64))).reshape(-1, 2)
    pixels = rays * [K[0, 0], K[1, 1]] + K[:2, 2]
    return Features(np.ascontiguousarray(pixels, np.float32), features.sizes, features.descriptors)


def _geometry(model: Any, one: Any, other: Any) -> Any:
    """The epipolar geometry of two placed photos."""
    relative = other.cam_from_world() * one.cam_from_world().inverse()
    x, y, z = relative.translation / max(float(np.linalg.norm(relative.translation)), 1e-12)
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ relative.rotation.matrix()
    inverse, other_inverse = (
        np.linalg.inv(model.cameras[image.camera_id].calibration_matrix()) for image in (one, other)
    )
    pycolmap = colmap_library()
    geometry = pycolmap.TwoViewGeometry()
    geometry.config = int(pycolmap.TwoViewGeometryConfiguration.CALIBRATED)
    geometry.E, geometry.F = essential, other_inverse.T @ essential @ inverse
    geometry.cam2_from_cam1 = relative
    return geometry
