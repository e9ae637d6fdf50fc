"""Metres per scene unit from a length that the user measured between points or cameras."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..config import UnitsConfig
from ..errors import SceneError
from .camera import Camera, FloatArray

_SAME_PLACE = 1e-6
"""Share of the cameras' spread below which two of them are at one position."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Metres per scene unit, and how it was measured.

    of: the measured object, in words; standard_error: of metres_per_unit, None for a single measurement.
    """

    metres_per_unit: float
    measure: Literal["metres_per_unit", "points", "cameras", "object", "gps"]
    of: str
    standard_error: float | None = None


def scale_by_length(config: UnitsConfig, names: Sequence[str], cameras: Sequence[Camera]) -> Scale | None:
    """The scale that the settings give directly or by two points or cameras; None if they give neither.

    names: of the cameras' photos, one each.

    Raises:
        SceneError: no camera has the photo's name, or both stand in one place.
    """
    if config.metres_per_unit is not None:
        return Scale(metres_per_unit=config.metres_per_unit, measure="metres_per_unit", of="as given")
    if config.length is None:
        return None
    if config.points is not None:
        ends = np.reshape(config.points, (2, 3))
        distance = float(np.linalg.norm(ends[0] - ends[1]))
        return Scale(
            metres_per_unit=config.length / distance,
            measure="points",
            of=f"{config.length:g} m between two points, {distance:.4g} units apart",
        )
    if config.cameras is None:
        return None
    first, second = (_center(name, names, cameras) for name in config.cameras)
    distance = float(np.linalg.norm(first - second))
    centers = np.stack([camera.center for camera in cameras])
    if distance <= _SAME_PLACE * np.linalg.norm(centers - centers.mean(0), axis=1).max():
        raise SceneError(
            f"The photos {config.cameras[0]} and {config.cameras[1]} were taken from one place. Name two from places "
            "whose distance you know"
        )
    return Scale(
        metres_per_unit=config.length / distance,
        measure="cameras",
        of=f"{config.length:g} m between the cameras of {config.cameras[0]} and {config.cameras[1]}",
    )


def _center(name: str, names: Sequence[str], cameras: Sequence[Camera]) -> FloatArray:
    """(3,) position of the photo of that name; all faces of a panorama share it.

    Raises:
        SceneError: the scene has no such photo.
    """
    for own, camera in zip(names, cameras, strict=True):
        if name in (own, own.partition("@")[0]):
            return camera.center
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
    raise SceneError(f"--units.cameras: the scene has no photo '{name}'. The nearest name is {nearest[0]}")
