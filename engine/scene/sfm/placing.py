"""Places photos one after the other (incremental structure from motion by pycolmap), from verified pairs."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...config import PhotosConfig
from ...progress import Progress, part
from ..pycolmap_import import colmap_library
from .features import Features
from .job import Job
from .joining import join_models, merge_photos
from .pairs import match_pairs, plan_retry_pairs, read_verified_images
from .views import deregister_photos

_LOST = 10.0
"""A photo this many times farther from the middle than most photos, and than the scene, is misplaced."""
_LEAST_INLIERS = (20, 8)
"""Points needed to place a photo, in the first attempt, and in a second one if the first did not place `ENOUGH`."""
LEAST_ANGLE = 1.5
"""Least angle in degrees between the rays of a triangulated point."""
CONVERGED = 1e-4
"""Relative change of the loss at which an adjustment ends, of points or while photos are placed: more accurate cameras
are left to `refining`."""
_AGAIN_ERROR = 4.0
"""Largest distance in pixels of a point from its features, on which photos are placed again."""
ENOUGH = 0.97
"""Share of the photos that is placed at the first attempt: a second one takes as long, and places few more."""


def register_photos(job: Job, features: Sequence[Features], report: Progress) -> list[Any]:
    """Register the photos: the models, largest first, of the attempt that placed most.

    If the first attempt placed less than `ENOUGH`, the photos that are not in its largest model are matched with more
    of the others, and a second attempt needs fewer points per photo.
    """
    best: list[Any] = []
    for attempt, least_inliers in enumerate(_LEAST_INLIERS):
        start = attempt / len(_LEAST_INLIERS)
        half = part(report, start, start + 1.0 / len(_LEAST_INLIERS))
        if attempt:
            match_pairs(job, features, plan_retry_pairs(job, features, _find_missing(job, best)), part(half, 0.0, 0.4))
        models = _models(job, least_inliers, part(half, 0.4 if attempt else 0.0, 1.0))
        if not best or (models and models[0].num_reg_images() > best[0].num_reg_images()):
            best = models
        if best and best[0].num_reg_images() >= ENOUGH * len(job.photos):
            break
    return best


def _find_missing(job: Job, models: Sequence[Any]) -> list[int]:
    """Find the photos that are not in the largest model, by their places."""
    placed = {image.name for image in models[0].images.values() if image.has_pose} if models else set()
    return [position for position, photo in enumerate(job.photos) if photo.copy not in placed]


def _models(job: Job, least_inliers: int, report: Progress) -> list[Any]:
    """The models of the photos, joined, largest first, with at least this many points per placed photo."""
    pycolmap = colmap_library()
    registered = itertools.count(3)

    def count() -> None:
        number = min(next(registered), len(job.photos))
        report(number / len(job.photos), f"placing photos: {number} of {len(job.photos)}")

    folder = Path(job.folder) / "models"
    folder.mkdir(exist_ok=True)
    report(0.0, f"placing photos: 0 of {len(job.photos)}")
    options = _mapping_options(job.config, least_inliers)
    models = pycolmap.incremental_mapping(job.database, job.copies, folder, options, next_image_callback=count)
    for model in models.values():
        drop_lost(model)
    return join_models(list(models.values()))


def register_again(job: Job, model: Any, uncertain: Collection[int], *, fixed: bool) -> Any:
    """Register the uncertain photos of a model, and those that it has no place for, again on the points of the others;
    None if none of them was placed.

    fixed: whether the others keep their places.
    """
    pycolmap = colmap_library()
    before = model.num_reg_images()
    model = deregister_photos(model, uncertain)
    for camera in model.cameras.values():
        camera.has_prior_focal_length = True
    # pycolmap does not know photos that no pair has.
    alone = set(model.reg_image_ids()) - {image for pair in read_verified_images(job) for image in pair}
    start, folder = _make_empty_folder(job, "again-start"), _make_empty_folder(job, "again")
    triangulate(job, job.database, deregister_photos(model, alone), _AGAIN_ERROR).write(start)
    options = _mapping_options(job.config, _LEAST_INLIERS[0])
    options.fix_existing_frames = fixed
    options.ba_refine_focal_length = options.ba_refine_extra_params = False
    found = pycolmap.incremental_mapping(job.database, job.copies, folder, options, input_path=start)
    again = max(found.values(), key=lambda each: each.num_reg_images(), default=None)
    if again is None:
        return None
    drop_lost(again)
    if alone:
        again = merge_photos(again, model, alone - set(again.reg_image_ids()))
    return again if again is not None and again.num_reg_images() > before - len(uncertain) else None


def triangulate(job: Job, database: Path, model: Any, error: float) -> Any:
    """Triangulate the points of all tracks in a database into the model, its cameras fixed.

    error: largest distance in pixels of a point from its features.
    """
    pycolmap = colmap_library()
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.extract_colors = False
    options.random_seed = options.triangulation.random_seed = options.mapper.random_seed = job.config.seed
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = LEAST_ANGLE
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = error
    options.mapper.filter_max_reproj_error = error
    options.ba_global_max_refinements, options.ba_global_function_tolerance = 1, CONVERGED
    folder, model = _make_empty_folder(job, "triangulated"), pycolmap.Reconstruction(model)
    return pycolmap.triangulate_points(model, database, job.copies, folder, clear_points=True, options=options)


def _make_empty_folder(job: Job, name: str) -> Path:
    """Make an empty folder of the job."""
    folder = Path(job.folder) / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def drop_lost(model: Any) -> None:
    """Remove photos from a model that are absurdly far away: distant objects alone, or noise, placed them."""
    placed = [image for image in model.images.values() if image.has_pose]
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    if not placed or not len(points):
        return
    centers = np.array([image.projection_center() for image in placed])
    middle = np.median(centers, axis=0)
    away = np.linalg.norm(centers - middle, axis=1)
    usual = max(np.percentile(away, 75), np.median(np.linalg.norm(points - middle, axis=1)))
    for image, distance in zip(placed, away, strict=True):
        if not distance <= _LOST * usual:  # NaN is removed too
            model.deregister_frame(image.frame_id)


def _mapping_options(config: PhotosConfig, least_inliers: int) -> Any:
    """COLMAP's options, relaxed for trees: few matches per pair, and most leaves visible in two photos only; one
    thread, seeded."""
    options = colmap_library().IncrementalPipelineOptions()
    options.num_threads = 1  # several sum in another order each time
    options.random_seed = config.seed
    options.min_model_size = 3
    options.min_num_matches = 8
    options.extract_colors = False
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    options.ba_global_max_refinements = 2
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = CONVERGED
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.random_seed = config.seed
    options.mapper.random_seed = config.seed
    options.mapper.num_threads = 1
    options.mapper.init_min_num_inliers = 50
    options.mapper.init_min_tri_angle = 8.0
    options.mapper.abs_pose_min_num_inliers = least_inliers
    options.mapper.abs_pose_min_inlier_ratio = 0.1
    options.mapper.abs_pose_max_error = 6.0
    options.mapper.filter_max_reproj_error = 2.0
    return options
