"""Refines placed photos: points from matches along epipolar lines are followed, and cameras are adjusted to them."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...progress import Progress, part
from ..pycolmap_import import colmap_library
from .features import Features, image_ids, photo_ids
from .job import LEAST_PHOTOS, Job
from .matching import match_along_lines
from .pairs import LARGEST, Pair, planned_pairs
from .placing import CONVERGED, LEAST_ANGLE, place_again, triangulated
from .resection import resected
from .tracks import longer_tracks
from .views import Pictures, read_pictures

_WIDE = ((25.0, 20.0), (10.0, 8.0))
"""Largest distance in pixels from an epipolar line, and then of a point from its features, in passes with the largest
features only. They bring parts of a capture together that a weak link placed."""
_CLOSE, _ALL = (5.0, 4.0), (2.5, 2.0)
"""The same of the matches that long tracks start from: of the largest features, then of all."""
_MOST_FEATURES = 650_000
"""Features of all photos together that points are made of in the end: training has room for a tenth as many."""
_ROUND, _LAST_ROUND = (4, 200), (3, 500)
"""Pixels around the predicted place of a point that are searched, and points per photo, those seen most often, that
adjust the cameras: until the last round, and in it. Fewer points take less time, more give more accurate cameras."""
_PARTS = 8
"""Columns and rows of the parts of a photo that share these points: without the outer ones the lens is not known."""
_LARGEST_ERROR = 4.0
"""Largest distance in pixels of a point of a long track from its observations."""
_UNCERTAIN = 0.5
"""Observations of a photo, relative to the median of all photos, below which it may be misplaced."""
_LEAST_SUPPORT = 8
"""Observations below which a photo is left out in the end, if enough photos remain."""
_SAME_PLACE = 0.05
"""Distance, relative to that of most photos from their middle, up to which a photo was placed again where it was."""
_ATTEMPTS, _LEAST_KEPT, _LEAST_GAIN = 3, 0.99, 1.005
"""Rounds that match again and follow the points; factor of the agreement that a round must keep, and below which no
other follows."""
_NEAREST = 12
"""Photos that each one is matched with: those with the most similar direction of view and place."""
_LARGEST_ANGLE = 45.0
"""Largest angle between the directions of view of a pair, in degrees: SIFT finds nothing beyond."""
_LEAST_POINTS = 40
"""Points that a model needs; and points per photo up to which those in two photos only are used: chance matched half of
these."""
_NEAR = 2.0
"""Distance from points that three photos see, in their median spacing, up to which a point of two photos is kept."""
_LOSS_SCALE = 0.5
"""Scale in pixels of the Cauchy loss."""
_ADJUSTMENTS = 2
"""Adjustments in each pass, with a removal of outliers after each."""
_CAMERAS_CONVERGED = 1e-6
"""Relative change of the loss at which an adjustment of cameras ends: a bent ring of cameras straightens slowly."""


_Tracked = Callable[[Any, Progress], Any]
"""A model → the model matched and followed again, with cameras adjusted to that."""


def refine(job: Job, features: Sequence[Features], model: Any, report: Progress) -> Any:
    """The model with cameras refined on longer tracks, and with the points of these; as it is with too few of them.

    Photos that are missing or that hardly any long track reaches are placed again, until that does not move them.
    """
    pictures = read_pictures(job)
    large = [each.largest(LARGEST) for each in features]
    _make_database(job)

    def tracked(start: Any, share: Progress) -> Any:
        seeds = _matched(job, features, large, start, _CLOSE, part(share, 0.0, 0.3))
        return _with_long_tracks(job, seeds, pictures, _ROUND, part(share, 0.3, 1.0))

    wide = model
    for number, limits in enumerate(_WIDE):
        wide = _passed(job, features, large, wide, limits, part(report, 0.1 * number, 0.1 * (number + 1)))
    both = [tracked(wide, part(report, 0.2, 0.3)), tracked(model, part(report, 0.3, 0.4))]
    best = max(both, key=_agreement)
    best, settled = _with_missing(job, features, best, tracked, part(report, 0.4, 0.5))
    for attempt in range(_ATTEMPTS):
        better = _improved(job, best, settled, tracked, part(report, 0.5 + 0.1 * attempt, 0.6 + 0.1 * attempt))
        if better is None:
            break
        gain = _agreement(better) / max(_agreement(best), 1)
        best = better
        if gain < _LEAST_GAIN:
            break
    seeds = on_surfaces(_matched_all(job, features, best, part(report, 0.8, 0.9)))
    best = _with_long_tracks(job, seeds, pictures, _LAST_ROUND, part(report, 0.9, 1.0))
    return held(best) if best.num_points3D() >= _LEAST_POINTS else model


def held(model: Any) -> Any:
    """The model without photos of fewer than 8 observations, unless too few would remain; it is changed."""
    loose = [image for image, count in _support(model).items() if count < _LEAST_SUPPORT]
    if model.num_reg_images() - len(loose) >= LEAST_PHOTOS:
        for image in loose:
            model.deregister_frame(model.images[image].frame_id)
    return model


def _with_missing(
    job: Job, features: Sequence[Features], model: Any, tracked: _Tracked, report: Progress
) -> tuple[Any, set[int]]:
    """The model with the missing photos that its points determine, and the ids of these photos."""
    if model.num_reg_images() == len(job.photos):
        return model, set()
    before, pairs = set(model.reg_image_ids()), planned_pairs(job, features)
    for attempt in range(_ATTEMPTS):
        share = part(report, attempt / _ATTEMPTS, (attempt + 1) / _ATTEMPTS)
        more = resected(job, features, pairs, _matched_all(job, features, model, part(share, 0.0, 0.5)))
        if more is None:
            break
        more = tracked(more, part(share, 0.5, 1.0))
        if _agreement(more) <= _LEAST_KEPT * _agreement(model):
            break
        model = more
        if model.num_reg_images() == len(job.photos):
            break
    held_well = {image for image, count in _support(model).items() if count >= _LEAST_SUPPORT}
    return model, held_well - before


def _improved(job: Job, model: Any, settled: set[int], tracked: _Tracked, report: Progress) -> Any:
    """The model matched and followed again, after its unsure photos were placed again if that moves them; None if that
    loses tracks. settled: photos that are not placed again; unsure ones that do not move are added."""
    unsure = _unsure(job, model) - settled
    for number, start in enumerate(starts(job, model, settled, unsure)):
        if start is model:
            settled |= unsure
        better = tracked(start, part(report, number / 2, (number + 1) / 2))
        if _agreement(better) > _LEAST_KEPT * _agreement(model):
            return better
    return None


def _unsure(job: Job, model: Any) -> set[int]:
    """The photos that are missing, and those with few observations."""
    support = _support(model)
    usual = float(np.median(list(support.values()))) if support else 0.0
    return {image for image in photo_ids(job) if support.get(image, -1) < _UNCERTAIN * usual}


def starts(job: Job, model: Any, settled: Collection[int], unsure: Collection[int]) -> Iterator[Any]:
    """Models to go on from, all with the settled photos that are placed: those in which the unsure photos were placed
    again, with the others fixed or not; the model itself if that is not possible or changes nothing."""
    before = set(model.reg_image_ids())
    uncertain, placed = before & set(unsure), False
    if unsure:
        for fixed in (True, False):
            again = place_again(job, model, uncertain, fixed=fixed)
            if again is None or not before & set(settled) <= set(again.reg_image_ids()):
                continue
            if same_places(model, again, uncertain):
                break
            placed = True
            yield again
    if not placed:
        yield model


def same_places(before: Any, after: Any, images: Collection[int]) -> bool:
    """Whether a model has as many photos as an earlier one, and these images where they were."""
    if after.num_reg_images() != before.num_reg_images() or not all(after.images[i].has_pose for i in images):
        return False
    centers = np.array([image.projection_center() for image in before.images.values() if image.has_pose])
    usual = float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))
    moved = [after.images[i].projection_center() - before.images[i].projection_center() for i in sorted(images)]
    return all(float(np.linalg.norm(each)) < _SAME_PLACE * usual for each in moved)


def _support(model: Any) -> dict[int, int]:
    """Observations of points, by photo."""
    return {number: image.num_points3D for number, image in model.images.items() if image.has_pose}


def _agreement(model: Any) -> int:
    """Photos that see points of three or more photos, beyond two each."""
    return sum(max(point.track.length() - 2, 0) for point in model.points3D.values())


def _with_long_tracks(job: Job, model: Any, pictures: Pictures, limits: tuple[int, int], report: Progress) -> Any:
    """The model with its points followed through all photos, and with cameras adjusted to those that most photos see;
    as it is if hardly any can be followed. limits: as in `_ROUND`."""
    reach, enough = limits
    report(0.0, "following points")
    longer = longer_tracks(job, model, pictures, reach)
    if longer.num_points3D() < _LEAST_POINTS:
        return model
    report(0.6, "refining cameras")
    kept = most_seen(longer, enough)
    _adjust(job, kept, _LARGEST_ERROR)
    for number, camera in kept.cameras.items():
        longer.cameras[number].params = camera.params
    for number, image in kept.images.items():
        longer.frame(longer.images[number].frame_id).rig_from_world = image.cam_from_world()
    _adjust(job, longer, _LARGEST_ERROR, points_only=True)
    return longer


def _passed(
    job: Job,
    features: Sequence[Features],
    chosen: Sequence[NDArray[np.int64]],
    model: Any,
    limits: tuple[float, float],
    report: Progress,
) -> Any:
    """The model with cameras adjusted to matches along its epipolar lines. limits: as in `_WIDE`."""
    _, enough = _ROUND
    kept = most_seen(_matched(job, features, chosen, model, limits, part(report, 0.0, 0.7)), enough)
    if kept.num_points3D() < _LEAST_POINTS:
        return model
    report(0.7, "refining cameras")
    _adjust(job, kept, limits[1])
    return kept


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


def _matched(
    job: Job,
    features: Sequence[Features],
    chosen: Sequence[NDArray[np.int64]],
    model: Any,
    limits: tuple[float, float],
    report: Progress,
) -> Any:
    """The model with the points of the chosen features that match along its epipolar lines; these matches replace
    those in the database. limits: as in `_WIDE`."""
    tolerance, error = limits
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
    return triangulated(job, _database(job), model, error)


def _matched_all(job: Job, features: Sequence[Features], model: Any, report: Progress) -> Any:
    """The model with the points of all features that match along its epipolar lines; of the largest, if photos are
    many."""
    count = max(LARGEST, _MOST_FEATURES // len(features))
    return _matched(job, features, [each.largest(count) for each in features], model, _ALL, report)


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


def most_seen(model: Any, enough: int) -> Any:
    """A copy with the points that most photos see, until each photo has about `enough` of them, spread over all of its
    parts."""
    kept = colmap_library().Reconstruction(model)
    parts = {number: _parts(model.cameras[image.camera_id], image) for number, image in model.images.items()}
    counts: Counter[tuple[int, int]] = Counter()
    ranked = sorted(kept.points3D.items(), key=lambda item: (-item[1].track.length(), item[1].error, item[0]))
    for number, point in ranked:
        seen = [(each.image_id, each.point2D_idx) for each in point.track.elements]
        places = {(image, parts[image][index]) for image, index in seen}
        share = (enough if len({image for image, _ in seen}) > 2 else _LEAST_POINTS) / _PARTS**2
        if min(counts[place] for place in places) >= share:
            kept.delete_point3D(number)
        else:
            counts.update(places)
    return kept


def _parts(camera: Any, image: Any) -> list[int]:
    """The number of the part of a photo that each of its features lies in."""
    pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
    column, row = (pixels * _PARTS / [camera.width, camera.height]).astype(int).T
    return (column + _PARTS * row).tolist()


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


def _adjust(job: Job, model: Any, error: float, *, points_only: bool = False) -> None:
    """Bundle adjustments with a robust loss, each followed by the removal of points and observations that are off by
    more than `error` pixels; photos of one camera share focal length and distortion.

    points_only: the cameras stay, and one adjustment is enough.
    """
    pycolmap = colmap_library()
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = False
    options.refine_rig_from_world = options.refine_focal_length = options.refine_extra_params = not points_only
    options.min_track_length = 2
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_SCALE
    options.ceres.use_gpu = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 30 if points_only else 100
    options.ceres.solver_options.function_tolerance = CONVERGED if points_only else _CAMERAS_CONVERGED
    for _ in range(1 if points_only else _ADJUSTMENTS):
        pycolmap.bundle_adjustment(model, options)
        pycolmap.ObservationManager(model).filter_all_points3D(error, LEAST_ANGLE)
