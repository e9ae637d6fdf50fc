"""Links two models of the same photos by a photo that both have, and by the points that it shows in both."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...alignment import Similarity
from ..joining import merge_models

_LEAST_COMMON = 8
"""Features of the photo that show a point in both models."""


def link_models(model: Any, other: Any) -> Any:
    """Return the photos of both models in the frame of the first, without points; None if no photo links them.

    model, other: with points of the same features. The photo whose features show most points in both gives place and
    direction; the depths of its points give the scale. That is rough: cameras must be adjusted afterwards.
    """
    shared = sorted(set(model.reg_image_ids()) & set(other.reg_image_ids()))
    ratios = {number: _depth_ratios(model, other, number) for number in shared}
    best = max(shared, key=lambda number: len(ratios[number]), default=None)
    if best is None or len(ratios[best]) < _LEAST_COMMON:
        return None
    own, theirs = (each.images[best].cam_from_world() for each in (model, other))
    scale, rotation = float(np.median(ratios[best])), own.rotation.matrix().T
    moved = Similarity(
        scale, rotation @ theirs.rotation.matrix(), rotation @ (scale * theirs.translation - own.translation)
    )
    return merge_models(model, other, moved, set(other.reg_image_ids()) - set(shared))


def _depth_ratios(model: Any, other: Any, number: int) -> NDArray[np.float64]:
    """Of the features of a photo that show a point in both models: the depth in the first over that in the second."""
    own, theirs = (_depths(each, number) for each in (model, other))
    return np.array([own[feature] / theirs[feature] for feature in sorted(own.keys() & theirs.keys())])


def _depths(model: Any, number: int) -> dict[int, float]:
    """The depth of the point that a feature shows, by feature."""
    image = model.images[number]
    turn = image.cam_from_world()
    return {
        feature: float((turn * model.points3D[seen.point3D_id].xyz)[2])
        for feature, seen in enumerate(image.points2D)
        if seen.has_point3D()
    }
