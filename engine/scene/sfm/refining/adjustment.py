"""Bundle adjustment of placed photos, and the points that it uses."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from ...pycolmap_import import colmap_library
from ..placing import CONVERGED, LEAST_ANGLE

LEAST_POINTS = 40
"""Points that a model needs; and points per photo up to which those in two photos only are used: chance matched half of
these."""
_PARTS = 8
"""Columns and rows of the parts of a photo that share its points: without the outer ones the lens is not known."""
_LOSS_SCALE = 0.5
"""Scale in pixels of the Cauchy loss."""
_ADJUSTMENTS = 2
"""Adjustments in each pass, with a removal of outliers after each."""
_CAMERAS_CONVERGED = 1e-6
"""Relative change of the loss at which an adjustment of cameras ends: a bent ring of cameras straightens slowly."""


def keep_most_seen(model: Any, enough: int) -> Any:
    """Return a copy with the points that most photos see, until each photo has about `enough` of them, spread over all
    of its parts."""
    kept = colmap_library().Reconstruction(model)
    parts = {number: _parts(model.cameras[image.camera_id], image) for number, image in model.images.items()}
    counts: Counter[tuple[int, int]] = Counter()
    ranked = sorted(kept.points3D.items(), key=lambda item: (-item[1].track.length(), item[1].error, item[0]))
    for number, point in ranked:
        seen = [(each.image_id, each.point2D_idx) for each in point.track.elements]
        places = {(image, parts[image][index]) for image, index in seen}
        share = (enough if len({image for image, _ in seen}) > 2 else LEAST_POINTS) / _PARTS**2
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


def adjust(model: Any, error: float, *, points_only: bool = False) -> None:
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
