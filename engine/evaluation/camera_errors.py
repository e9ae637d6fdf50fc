"""How far cameras that were found from photos are from the true ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..scene.alignment import Similarity, align
from ..scene.camera import Camera


@dataclass(frozen=True, kw_only=True)
class CameraErrors:
    """Errors of found cameras after the similarity that fits their centres best to the true ones.

    placed, photos: number of found and of true cameras; center, rotation: median error, in scene units of the truth and
    in degrees; center_90, rotation_90: 90th percentile.
    """

    placed: int
    photos: int
    center: float
    center_90: float
    rotation: float
    rotation_90: float


def camera_similarity(found: Mapping[str, Camera], true: Mapping[str, Camera]) -> Similarity:
    """The similarity from the frame of `found` to that of `true`, by the centres of the cameras that both name.

    Raises:
        SceneError: fewer than 3 are common, or they stand on one line.
    """
    common = [name for name in found if name in true]
    return align(
        np.array([found[name].center for name in common]).reshape(-1, 3),
        np.array([true[name].center for name in common]).reshape(-1, 3),
    )


def camera_errors(found: Mapping[str, Camera], true: Mapping[str, Camera]) -> CameraErrors:
    """The errors of the cameras that both mappings name.

    Raises:
        SceneError: as `camera_similarity`.
    """
    common = [name for name in found if name in true]
    moved = camera_similarity(found, true)
    ours, theirs = (np.array([cameras[name].center for name in common]) for cameras in (found, true))
    centers = np.linalg.norm(moved.apply(ours) - theirs, axis=1)
    turns = np.stack([
        found[name].world_to_camera[:3, :3] @ moved.rotation.T @ true[name].world_to_camera[:3, :3].T for name in common
    ])  # fmt: skip
    traces = np.trace(turns, axis1=1, axis2=2)
    rotations = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    return CameraErrors(
        placed=len(common),
        photos=len(true),
        center=float(np.median(centers)),
        center_90=float(np.percentile(centers, 90)),
        rotation=float(np.median(rotations)),
        rotation_90=float(np.percentile(rotations, 90)),
    )
