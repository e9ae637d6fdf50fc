"""Camera poses that are optimised together with the Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...scene.camera import Camera
from .view_adam import ViewMoments, decay_rate

RATE, LAST_RATE = 5e-3, 5e-5
"""Adam's rate at the first and at the last step: radians, and scene extents."""
FloatArray = NDArray[np.float64]


@dataclass(eq=False)
class Poses(ViewMoments):
    """Refined poses and Adam's moments in their tangents (rotation vector, translation; both in the camera frame).

    world_to_camera: (V, 4, 4); the moments are (V, 6).
    """

    world_to_camera: FloatArray

    @staticmethod
    def of(cameras: Sequence[Camera]) -> Poses:
        """The original poses."""
        n = len(cameras)
        matrices = np.stack([camera.world_to_camera for camera in cameras]).astype(np.float64)
        return Poses(np.zeros((n, 6)), np.zeros((n, 6)), np.zeros(n, np.int32), matrices)

    def camera(self, view: int, camera: Camera) -> Camera:
        """A camera (of any size) at the view's refined pose."""
        return replace(camera, world_to_camera=self.world_to_camera[view])

    def learn(self, view: int, sums: FloatArray, done: float, extent: float) -> None:
        """Update one pose with Adam.

        sums: (15,) see `twist_gradient`; done: share of the training that is over; extent: scene units.
        """
        g = twist_gradient(self.world_to_camera[view], sums)
        g[3:] *= extent
        twist = -self.step(view, g, decay_rate(RATE, LAST_RATE, done))
        twist[3:] *= extent
        self.world_to_camera[view] = apply_twist(self.world_to_camera[view], twist)


def twist_gradient(world_to_camera: FloatArray, sums: FloatArray) -> FloatArray:
    """(6,) gradient of the twist (rotation vector, translation) that `apply_twist` applies, at zero.

    sums: (15,) over Gaussians, as `project_backward` adds them up: gradient of their positions in the camera's frame
    (3), of the rotation matrix through positions from the camera's centre and through covariances (9, row by row), and
    of their positions in the world through the direction they are seen from (3).
    """
    R = world_to_camera[:3, :3]
    translation = sums[:3] + R @ sums[12:15]  # a camera that moves by -Rᵀτ sees along other directions
    A = sums[3:12].reshape(3, 3) @ R.T
    rotation = np.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])
    return np.concatenate([rotation, translation])


def apply_twist(world_to_camera: FloatArray, twist: FloatArray) -> FloatArray:
    """Rotate a pose by twist[:3] (a rotation vector) and then shift it by twist[3:] in the camera's frame."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix()
    change[:3, 3] = twist[3:]
    return change @ world_to_camera
