"""Cameras, photos and the scene: the input of every later stage.

Frames are COLMAP's: world_to_camera maps to x right, y down, z forward; pixel (0, 0) is the corner of the top left
pixel, whose centre is (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with its pose.

    K: (3, 3) intrinsics in pixels; world_to_camera: (4, 4) rigid transform in scene units; distortion: OpenCV
    coefficients, None once a photo has been undistorted (as every camera of a loaded `Scene` is).
    """

    K: FloatArray
    world_to_camera: FloatArray
    width: int
    height: int
    distortion: FloatArray | None = None

    @property
    def center(self) -> FloatArray:
        """(3,) the camera's position in the world."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    @property
    def forward(self) -> FloatArray:
        """(3,) unit viewing direction in the world."""
        return self.world_to_camera[2, :3]

    def resize(self, width: int, height: int) -> Camera:
        """Return the same camera with a picture of this size, in pixels."""
        K = np.diag([width / self.width, height / self.height, 1.0]) @ self.K
        return replace(self, K=K, width=width, height=height)

    def scale(self, factor: float) -> Camera:
        """Return the same camera with its picture `factor` times as wide and high, in whole pixels, at least one."""
        if factor == 1.0:
            return self
        return self.resize(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(…, 2) pixels and (…,) depths along the axis, in scene units, of (…, 3) points in the world.

        A pixel is valid only if its depth is above 0; distortion is ignored.
        """
        x, y, z = np.moveaxis(points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3], -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = self.K[0, 0] * x / z + self.K[0, 2], self.K[1, 1] * y / z + self.K[1, 2]
        return np.stack([u, v], axis=-1), z

    def find_in_frame(self, points: FloatArray) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
        """Find which points (N, 3) lie in the picture (N,), whatever hides them, with pixels and depths as of
        `project`."""
        pixels, depths = self.project(points)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= 0.0).all(axis=1) & (pixels < [self.width, self.height]).all(axis=1)
        return inside & (depths > 0.0), pixels, depths

    def unproject(self, depths: FloatArray) -> FloatArray:
        """(H, W, 3) points in the world at the centres of the pixels, from (H, W) depths along the axis, in scene
        units.

        Distortion is ignored.
        """
        v, u = np.mgrid[: self.height, : self.width] + 0.5
        x, y = (u - self.K[0, 2]) / self.K[0, 0], (v - self.K[1, 2]) / self.K[1, 1]
        rays = np.stack([x, y, np.ones_like(u)], axis=-1)
        return (rays * depths[..., None]) @ self.world_to_camera[:3, :3] + self.center


def look_along(place: FloatArray, along: FloatArray, up: FloatArray) -> FloatArray:
    """Return (4, 4) world_to_camera of a level camera at `place` (3,) that looks along (3,), of any length; up (3,)."""
    forward = along / np.linalg.norm(along)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ place
    return pose


class Photo(Protocol):
    """A photo that loads on demand, already undistorted and at its camera's size."""

    @property
    def name(self) -> str: ...

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB."""
        ...

    def mask(self) -> NDArray[np.bool_] | None:
        """(H, W) True where the photo may be used; None if every pixel may."""
        ...


@dataclass(frozen=True, eq=False)
class ArrayPhoto:
    """A photo in memory."""

    name: str
    array: NDArray[np.uint8]
    valid: NDArray[np.bool_] | None = None

    def pixels(self) -> NDArray[np.uint8]:
        return self.array

    def mask(self) -> NDArray[np.bool_] | None:
        return self.valid


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed photos with a sparse cloud, in the frame of the input model.

    cameras and images: one each per view, in name order; points: (P, 3) scene units; colors: (P, 3) uint8 sRGB; up:
    (3,) unit vector away from the ground; metres_per_unit: None if the scale is unknown.
    """

    cameras: Sequence[Camera]
    images: Sequence[Photo]
    points: FloatArray
    colors: NDArray[np.uint8]
    up: FloatArray
    metres_per_unit: float | None = None

    def of_views(self, views: NDArray[np.int64]) -> Scene:
        """The scene of some of its views, with those points that one of them frames."""
        cameras = [self.cameras[view] for view in views]
        points = np.asarray(self.points, np.float64)
        seen = np.zeros(len(points), bool)
        for camera in cameras:
            seen |= camera.find_in_frame(points)[0]
        images = [self.images[view] for view in views]
        return replace(self, cameras=cameras, images=images, points=self.points[seen], colors=self.colors[seen])

    @property
    def extent(self) -> float:
        """`spread` times 1.1 (3DGS's scene extent), in scene units."""
        return 1.1 * self.spread

    @property
    def middle(self) -> FloatArray:
        """(3,) mean of the cameras' centres, in scene units."""
        return np.stack([camera.center for camera in self.cameras]).mean(0)

    @property
    def spread(self) -> float:
        """Radius of the cameras about their middle, in scene units.

        If they are all at one position, the median distance of the points from there, and 1 without points.
        """
        centers, middle = np.stack([camera.center for camera in self.cameras]), self.middle
        spread = float(np.linalg.norm(centers - middle, axis=1).max())
        points = np.asarray(self.points, np.float64)
        distances = np.linalg.norm(points[np.isfinite(points).all(1)] - middle, axis=1)
        points_spread = float(np.median(distances)) if distances.any() else 1.0
        rounding = max(float(np.abs(centers).max()), points_spread)
        return spread if spread > 1e-6 * rounding else points_spread


def axes_equations(cameras: Sequence[Camera]) -> tuple[FloatArray, FloatArray]:
    """(3, 3) matrix and (3,) right side of the linear system whose solution is the point nearest to all viewing axes.

    The axis c + t·d is at distance |(I - ddᵀ)(p - c)| of p. For parallel axes the matrix is singular.
    """
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.forward for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    return across.sum(0), (across @ centers[:, :, None]).sum(0)[:, 0]
