"""Estimates which way is up from how the cameras were held."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .camera import Camera, FloatArray

_IMAGE_TOP = np.array([0.0, -1.0, 0.0])


def up_direction(cameras: Sequence[Camera], skyward: Sequence[FloatArray] | None = None) -> FloatArray:
    """(3,) unit vector away from the ground, in the world's frame.

    Cameras are held level, so their sideways axes lie in the plane of the ground, so up is the direction most nearly
    perpendicular to all of them, min Σ |sᵢ·u| (by reweighted least squares, so that a few rolled photos do not tilt
    it). Its sign follows the tops of most photos or, if all look straight down, points away from their view.

    When all sideways axes are parallel (one strip, all facing the same way) that plane is not determined: up is then
    the direction of the photos' tops if they agree, else against the view if the views agree (a drone flying to and
    fro), else along the sideways axis (a phone held upright whose photos have no EXIF orientation).

    skyward: (3,) per photo, the direction of its top in the camera frame; the top edge of the image if not given.
    """
    tops_in_camera = [_IMAGE_TOP] * len(cameras) if skyward is None else skyward
    rotations = np.stack([camera.world_to_camera[:3, :3] for camera in cameras])
    tops = np.einsum("nij,ni->nj", rotations, np.stack(tops_in_camera))
    backs = -rotations[:, 2]
    sides = np.cross(tops, backs)
    weights = np.ones(len(sides))
    for _ in range(30):
        spread, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, sides, sides))
        up = axes[:, 0]
        if spread[1] < 0.02 * spread[2]:
            return _up_of_parallel(sides, tops, backs)
        weights = 1.0 / np.maximum(np.abs(sides @ up), 0.01)
    agreement = float((tops @ up).mean())
    if abs(agreement) < 0.2:
        agreement = float((backs @ up).mean())
    return up if agreement >= 0.0 else -up


def _up_of_parallel(sides: FloatArray, tops: FloatArray, backs: FloatArray) -> FloatArray:
    aligned = sides * np.where(sides @ sides[0] < 0.0, -1.0, 1.0)[:, None]
    for directions in (tops, backs):
        mean = directions.mean(axis=0)
        if np.linalg.norm(mean) > 0.8:
            return mean / np.linalg.norm(mean)
    mean = -aligned.mean(axis=0)  # phones store portrait photos rotated so that x points down
    return mean / np.linalg.norm(mean)


def upright_rotation(up: FloatArray) -> FloatArray:
    """(3, 3) the smallest rotation that takes the unit vector `up` to +Z (Blender's up)."""
    up = np.asarray(up, dtype=np.float64)
    up = up / np.linalg.norm(up)
    if up[2] < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    v = np.array([up[1], -up[0], 0.0])  # up × z
    cross = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + up[2])
