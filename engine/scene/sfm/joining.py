"""Joins models of the same photos: where two share photos, the photos of one move into the frame of the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ...errors import SceneError
from ..alignment import Similarity, align
from ..pycolmap_import import colmap_library

LEAST_SHARED = 4
"""Photos that two models must share."""
_LARGEST_ERROR = 0.1
"""Largest median distance between the places of shared photos, in the median distance of these from their middle."""


def joined(models: Sequence[Any]) -> list[Any]:
    """The models, largest first, each with the photos of those that it could be joined with.

    A joined model has cameras and photos, without points: `refinement` finds these again.
    """
    remaining = sorted(models, key=lambda model: -model.num_reg_images())
    result = []
    while remaining:
        model, *remaining = remaining
        for other in list(remaining):
            moved = _similarity(other, model)
            if moved is not None:
                model = _with_photos_of(model, other, moved)
                remaining.remove(other)
        result.append(model)
    return sorted(result, key=lambda model: -model.num_reg_images())


def _similarity(other: Any, model: Any) -> Similarity | None:
    """What maps `other` to the frame of `model`; None if they share too few photos, or these do not agree."""
    shared = sorted(set(other.reg_image_ids()) & set(model.reg_image_ids()))
    if len(shared) < LEAST_SHARED:
        return None
    source, target = (np.array([each.images[i].projection_center() for i in shared]) for each in (other, model))
    try:
        moved = align(source, target)
    except SceneError:  # all on one line
        return None
    error = float(np.median(np.linalg.norm(moved.apply(source) - target, axis=1)))
    spread = float(np.median(np.linalg.norm(target - np.median(target, axis=0), axis=1)))
    return moved if error <= _LARGEST_ERROR * spread else None


def _with_photos_of(model: Any, other: Any, moved: Similarity) -> Any:
    """A model of the photos of both, with the poses of `model` for shared ones."""
    pycolmap = colmap_library()
    both = pycolmap.Reconstruction()
    own = set(model.reg_image_ids())
    poses = {i: model.images[i].cam_from_world() for i in own}
    for i in other.reg_image_ids():
        poses.setdefault(i, _moved(other.images[i], moved))
    for i in sorted(poses):
        image = (model if i in own else other).images[i]
        if image.camera_id not in both.cameras:
            owner = model if image.camera_id in model.cameras else other
            both.add_camera_with_trivial_rig(owner.cameras[image.camera_id])
        points = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        copy = pycolmap.Image(name=image.name, keypoints=points, camera_id=image.camera_id, image_id=i)
        both.add_image_with_trivial_frame(copy, poses[i])
    return both


def _moved(image: Any, moved: Similarity) -> Any:
    pycolmap = colmap_library()
    rotation = image.cam_from_world().rotation.matrix() @ moved.rotation.T
    center = moved.apply(np.asarray(image.projection_center()))
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center)
