"""Ground truth of a generated scene in addition to its photos: the fruit id and the depth of every pixel."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from ..errors import FormatError
from ..scene.camera import Camera, Scene
from .truth import Truth

INSTANCES, DEPTH = "instances", "depth"
MILLIMETRE = 1e-3
"""Depth images are in thousandths of a scene unit along the optical axis, as nerfstudio's; 0 is nothing."""

LEAST_AGREEMENT = 0.5
"""Least share of the masks of visible fruit that must lie where the truth places the fruit."""


def read_instances(scene_folder: Path, scene: Scene) -> list[NDArray[np.uint16]]:
    """The (H, W) fruit ids of every view of the scene, 0 for none.

    Raises:
        FormatError: a mask is missing, is no 16-bit picture or has not its camera's size.
    """
    return [_picture(scene_folder / INSTANCES, name, camera) for name, camera in _views(scene)]


def read_depths(scene_folder: Path, scene: Scene) -> list[NDArray[np.float32]]:
    """The (H, W) depths of every view of the scene, in scene units along the optical axis, 0 for nothing.

    Raises:
        FormatError: as `read_instances`.
    """
    pictures = (_picture(scene_folder / DEPTH, name, camera) for name, camera in _views(scene))
    return [(picture * MILLIMETRE).astype(np.float32) for picture in pictures]


def check_instances(truth: Truth, cameras: Sequence[Camera], instances: Sequence[NDArray[np.uint16]]) -> None:
    """Refuse a truth that belongs to other pictures.

    At least half of the masks of visible fruit must overlap the disc of the fruit's sphere.

    Raises:
        FormatError: they do not, or the truth has no ids to look for.
    """
    if truth.ids is None:
        raise FormatError("The truth has no fruit ids, so its instance masks mean nothing. Make the scene again")
    masks, agreeing = 0, 0
    visible = np.flatnonzero(truth.visible)
    for camera, mask in zip(cameras, instances, strict=True):
        shown = np.isin(truth.ids[visible], np.unique(mask))
        masks += int(shown.sum())
        agreeing += sum(
            _is_seen_at(camera, mask, truth.centers[fruit], truth.diameters[fruit], int(truth.ids[fruit]))
            for fruit in visible[shown]
        )
    if len(visible) and agreeing < max(LEAST_AGREEMENT * masks, 1):
        raise FormatError(
            f"Only {agreeing} of {masks} masks of visible fruit are where the truth says the fruit are. "
            "It is the truth of another scene: make the scene again"
        )


def _views(scene: Scene) -> list[tuple[str, Camera]]:
    return [(photo.name, camera) for photo, camera in zip(scene.images, scene.cameras, strict=True)]


def _picture(folder: Path, name: str, camera: Camera) -> NDArray[np.uint16]:
    path = folder / Path(name).with_suffix(".png").name
    try:
        with Image.open(path) as image:
            values = np.asarray(image)
    except FileNotFoundError as error:
        raise FormatError(f"{path} is missing: the scene is incomplete. Run make_orchard.py again to resume") from error
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
        raise FormatError(f"{path} is damaged ({error}). Remove it and make the scene again") from error
    if values.ndim != 2 or not np.issubdtype(values.dtype, np.integer):
        raise FormatError(f"{path} is not a 16-bit image. Make the scene again")
    if values.shape != (camera.height, camera.width):
        raise FormatError(
            f"{path} has {values.shape[1]}×{values.shape[0]} pixels, its photo {camera.width}×{camera.height}. "
            "Leave out --scene.downscale and --scene.max-side, or make the scene again if this is another scene's"
        )
    return values.astype(np.uint16)


def _is_seen_at(
    camera: Camera, mask: NDArray[np.uint16], center: NDArray[np.float64], diameter: float, number: int
) -> bool:
    (u, v), z = camera.project(center)
    if z <= diameter:
        return False
    across, along = (max(1.0, camera.K[axis, axis] * 0.5 * diameter / z) for axis in (0, 1))
    window = mask[max(int(v - along), 0) : int(v + along) + 1, max(int(u - across), 0) : int(u + across) + 1]
    return u + across >= 0 and v + along >= 0 and bool((window == number).any())
