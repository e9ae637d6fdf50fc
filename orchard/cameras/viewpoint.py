"""A camera that takes one picture, in COLMAP's convention (x right, y down, z forward)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..shapes.branch import to_unit

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """A pinhole camera. A pixel's centre lies at half-integers; the principal point is the picture's middle."""

    name: str
    """File name of its picture."""
    focal: float
    """In pixels."""
    width: int
    height: int
    world_to_camera: FloatArray
    """(3, 4) rotation and translation, metres."""
    nearest: float = 0.02
    """Near clipping distance, metres along the optical axis."""

    @property
    def position(self) -> FloatArray:
        """(3,) the position of the camera in the world."""
        return -self.world_to_camera[:, :3].T @ self.world_to_camera[:, 3]

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(M, 2) pixels and (M,) depths of (M, 3) world points."""
        local = points @ self.world_to_camera[:, :3].T + self.world_to_camera[:, 3]
        middle = np.array([self.width / 2, self.height / 2])
        return local[:, :2] / local[:, 2:] * self.focal + middle, local[:, 2]

    def unproject(self, pixels: FloatArray, depths: FloatArray) -> FloatArray:
        """(M, 3) world points at depths (along the optical axis) behind (M, 2) pixels."""
        middle = np.array([self.width / 2, self.height / 2])
        rays = np.hstack([(pixels - middle) / self.focal, np.ones((len(pixels), 1))])
        return (rays * depths[:, None] - self.world_to_camera[:, 3]) @ self.world_to_camera[:, :3]


def look_at(position: FloatArray, target: FloatArray, roll: float = 0.0) -> FloatArray:
    """(3, 4) world_to_camera of a camera at `position` that looks at `target`, z up in the world."""
    forward = to_unit(target - position)
    right = to_unit(np.cross(forward, [0.0, 0.0, 1.0]))
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    return np.hstack([rotation, (-rotation @ position)[:, None]])
