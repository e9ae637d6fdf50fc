"""Joins models of the same photos: where two share photos, the photos of one move into the frame of the other."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SceneError
from ..alignment import Similarity, align
from ..pycolmap_import import colmap_library
from .views import PlacedPhoto, model_of

LEAST_SHARED = 4
"""Photos that two models must share."""
_LARGEST_ERROR = 0.1
"""Largest median distance between the places of shared photos, in the median distance of these from their middle."""


def join_models(models: Sequence[Any]) -> list[Any]:
    """Return the models, largest first, each with the photos of those that it could be joined with.

    A joined model has cameras and photos, without points: `refining` finds these again.
    """
    ordered = sorted(models, key=lambda model: -model.num_reg_images())
    for model, other in itertools.combinations(ordered, 2):
        moved = _similarity(other, model)
        if moved is not None:
            new = set(other.reg_image_ids()) - set(model.reg_image_ids())
            others = [each for each in ordered if each is not model and each is not other]
            return join_models([merge_models(model, other, moved, new), *others])
    return ordered


def align_models(other: Any, model: Any, shared: Sequence[int]) -> tuple[Similarity, NDArray[np.float64], float] | None:
    """Find what maps `other` to the frame of `model` by the (N,) photos that they share; (N,) how far these are then
    from their places; the median distance of these places from their middle. None if `align` refuses them."""
    source, target = (np.array([each.images[i].projection_center() for i in shared]) for each in (other, model))
    try:
        moved = align(source, target)
    except SceneError:  # too few, or all on one line
        return None
    errors = np.linalg.norm(moved.apply(source) - target, axis=1)
    return moved, errors, float(np.median(np.linalg.norm(target - np.median(target, axis=0), axis=1)))


def _similarity(other: Any, model: Any) -> Similarity | None:
    """What maps `other` to the frame of `model`; None if they share too few photos, or these do not agree."""
    shared = sorted(set(other.reg_image_ids()) & set(model.reg_image_ids()))
    found = align_models(other, model, shared) if len(shared) >= LEAST_SHARED else None
    if found is None:
        return None
    moved, errors, spread = found
    return moved if float(np.median(errors)) <= _LARGEST_ERROR * spread else None


def merge_photos(model: Any, other: Any, photos: Collection[int]) -> Any:
    """Return the model, without points, with these photos of another one; None if others that both have do not
    agree."""
    moved = _similarity(other, model)
    return None if moved is None else merge_models(model, other, moved, photos)


def merge_models(model: Any, other: Any, moved: Similarity, photos: Collection[int]) -> Any:
    """Return the photos of `model`, without points, and in its frame these of `other`."""
    both = [(image, image.cam_from_world()) for image in model.images.values() if image.has_pose]
    both += [(other.images[i], _transform_pose(other.images[i], moved)) for i in photos]
    cameras = {i: camera for each in (other, model) for i, camera in each.cameras.items()}
    return model_of(
        PlacedPhoto(image.image_id, image.name, cameras[image.camera_id], pose, _pixels(image)) for image, pose in both
    )


def _pixels(image: Any) -> NDArray[np.float64]:
    return np.array([point.xy for point in image.points2D]).reshape(-1, 2)


def _transform_pose(image: Any, moved: Similarity) -> Any:
    pycolmap = colmap_library()
    rotation = image.cam_from_world().rotation.matrix() @ moved.rotation.T
    center = moved.apply(np.asarray(image.projection_center()))
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center)
