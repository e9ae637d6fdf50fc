"""Refines placed photos: all features are matched again along their epipolar lines, then cameras are adjusted."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...progress import Progress, part
from ..pycolmap_import import colmap_library
from .features import Features, image_ids
from .job import Job
from .matching import match_along_lines
from .pairs import LARGEST, Pair

_WIDE = ((25.0, 20.0), (10.0, 8.0))
"""Largest distance in pixels from an epipolar line, and then of a point from its features, in passes with the largest
features only. They bring parts of a capture together that a weak link placed, but may lose another weak link."""
_FIRST, _FINE = (5.0, 4.0), ((2.5, 2.0), (1.5, 1.2))
"""The same of the passes with all features: the first starts with and without the wide ones, and the better goes on."""
_NEAREST = 12
"""Photos that each one is matched with: those with the most similar direction of view and place."""
_LARGEST_ANGLE = 45.0
"""Largest angle between the directions of view of a pair, in degrees: SIFT finds nothing beyond."""
_LEAST_ANGLE = 1.5
"""Least angle in degrees between the rays of a point."""
_ENOUGH_POINTS, _LEAST_POINTS = 600, 40
"""Points per photo, those seen most often, that adjust the cameras, as more take longer and change nothing; and points
per photo up to which those in two photos only are used, half of which are matched by chance."""
_NEAR = 2.0
"""Distance from points that three photos see, in their median spacing, up to which a point of two photos is kept."""
_LOSS_SCALE = 0.5
"""Scale in pixels of the Cauchy loss."""
_ADJUSTMENTS = 2
"""Adjustments in each pass, with a removal of outliers after each."""


@dataclass(frozen=True, eq=False)
class _Pass:
    """model: with adjusted cameras and the points that adjusted them; agreement: photos that see points of three or
    more photos, beyond two each."""

    model: Any
    agreement: int


def refine(job: Job, features: Sequence[Features], model: Any, report: Progress) -> Any:
    """The model with cameras refined on longer tracks, and with the points of these; as it is with too few of them."""
    large = [each.largest(LARGEST) for each in features]
    everything = [np.arange(len(each)) for each in features]
    _make_database(job)
    wide = model
    for number, limits in enumerate(_WIDE):
        share = part(report, 0.1 * number, 0.1 * (number + 1))
        wide = _refined(job, features, large, wide, limits, share).model
    starts = [
        _refined(job, features, everything, start, _FIRST, part(report, 0.2 * number, 0.2 * (number + 1)))
        for number, start in enumerate((wide, model), start=1)
    ]
    best = max(starts, key=lambda each: each.agreement)
    for number, limits in enumerate(_FINE, start=3):
        best = _refined(job, features, everything, best.model, limits, part(report, 0.2 * number, 0.2 * (number + 1)))
    if best.model.num_points3D() < _LEAST_POINTS:
        return model
    return on_surfaces(_triangulated(job, best.model, _FINE[-1][1]))


def _refined(
    job: Job,
    features: Sequence[Features],
    chosen: Sequence[NDArray[np.int64]],
    model: Any,
    limits: tuple[float, float],
    report: Progress,
) -> _Pass:
    """The model after one pass with the chosen features of each photo. limits: as in `_FIRST`."""
    tolerance, error = limits
    _match_again(job, features, chosen, model, tolerance, part(report, 0.0, 0.7))
    report(0.7, "refining cameras")
    triangulated = _triangulated(job, model, error)
    agreement = sum(max(point.track.length() - 2, 0) for point in triangulated.points3D.values())
    kept = _most_seen(triangulated)
    if kept.num_points3D() < _LEAST_POINTS:
        return _Pass(model, agreement)
    for _ in range(_ADJUSTMENTS):
        _adjust(job, kept)
        colmap_library().ObservationManager(kept).filter_all_points3D(error, _LEAST_ANGLE)
    return _Pass(kept, agreement)


def _database(job: Job) -> Path:
    """The database of the matches along epipolar lines."""
    return job.database.with_name("refined.db")


def _make_database(job: Job) -> None:
    """Copy the photos and the places of their features to the database of the refinement."""
    shutil.copy(job.database, _database(job))
    database = colmap_library().Database.open(_database(job))
    database.clear_matches()
    database.clear_descriptors()
    database.close()


def _match_again(
    job: Job,
    features: Sequence[Features],
    chosen: Sequence[NDArray[np.int64]],
    model: Any,
    tolerance: float,
    report: Progress,
) -> None:
    """Replace the matches in the database by those of placed photos along their epipolar lines, of the chosen
    features."""
    database = colmap_library().Database.open(_database(job))
    try:
        numbers = image_ids(database, job)
        database.clear_two_view_geometries()
        placed = {i: model.images[number] for i, number in enumerate(numbers) if _has_pose(model, number)}
        straight = {
            i: _undistorted(model.cameras[image.camera_id], features[i].select(chosen[i]))
            for i, image in placed.items()
        }
        pairs = near_pairs(placed)
        for done, (i, j) in enumerate(pairs):
            report(done / len(pairs), f"matching placed photos: pair {done + 1} of {len(pairs)}")
            geometry = _geometry(model, placed[i], placed[j])
            matches = match_along_lines(geometry.F, straight[i], straight[j], tolerance)
            if matches is not None:
                numbered = np.stack([chosen[i][matches[:, 0]], chosen[j][matches[:, 1]]], axis=1)
                geometry.inlier_matches = numbered.astype(np.uint32)
                database.write_two_view_geometry(numbers[i], numbers[j], geometry)
    finally:
        database.close()


def _has_pose(model: Any, image: int) -> bool:
    return image in model.images and model.images[image].has_pose


def near_pairs(placed: Mapping[int, Any]) -> list[Pair]:
    """The pairs of photos that may show the same: similar directions of view from near places."""
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
    pairs = set()
    for row, ranked in enumerate(np.argsort(cost, axis=1, kind="stable")[:, :_NEAREST]):
        pairs |= {(min(row, int(k)), max(row, int(k))) for k in ranked if np.isfinite(cost[row, k])}
    return [(order[i], order[j]) for i, j in sorted(pairs)]


def _undistorted(camera: Any, features: Features) -> Features:
    """The features at the pixels where they would be without distortion of the lens."""
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


def _triangulated(job: Job, model: Any, error: float) -> Any:
    """The model with the points of all tracks in the database, its cameras fixed."""
    pycolmap = colmap_library()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    options.random_seed = options.triangulation.random_seed = options.mapper.random_seed = job.config.seed
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = _LEAST_ANGLE
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = error
    options.mapper.filter_max_reproj_error = error
    folder = Path(job.folder) / "refined"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return pycolmap.triangulate_points(model, _database(job), job.copies, folder, clear_points=True, options=options)


def _most_seen(model: Any) -> Any:
    """A copy with the points that most photos see, as many as each photo needs."""
    kept = colmap_library().Reconstruction(model)
    counts: dict[int, int] = {}
    ranked = sorted(kept.points3D.items(), key=lambda item: (-item[1].track.length(), item[1].error, item[0]))
    for number, point in ranked:
        images = {element.image_id for element in point.track.elements}
        if min(counts.get(image, 0) for image in images) >= (_ENOUGH_POINTS if len(images) > 2 else _LEAST_POINTS):
            kept.delete_point3D(number)
            continue
        for image in images:
            counts[image] = counts.get(image, 0) + 1
    return kept


def on_surfaces(model: Any) -> Any:
    """A copy without the points that chance matched: those that only two photos see, far from points that more see."""
    kept = colmap_library().Reconstruction(model)
    sure = np.array([point.xyz for point in model.points3D.values() if point.track.length() > 2]).reshape(-1, 3)
    if len(sure) < _LEAST_POINTS:
        return kept
    tree = cKDTree(sure)
    spacing = float(np.median(tree.query(sure, k=2)[0][:, 1]))
    for number, point in model.points3D.items():
        if point.track.length() == 2 and tree.query(point.xyz)[0] > _NEAR * spacing:
            kept.delete_point3D(number)
    return kept


def _adjust(job: Job, model: Any) -> None:
    """Bundle adjustment with a robust loss; photos of one camera share focal length and distortion."""
    pycolmap = colmap_library()
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.min_track_length = 2
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_SCALE
    options.ceres.use_gpu = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 30
    pycolmap.bundle_adjustment(model, options)
