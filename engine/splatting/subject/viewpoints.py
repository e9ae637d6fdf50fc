"""Cameras for a reconstruction that has none: subject, up direction and viewpoints."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.camera import Camera, look_along
from ..gaussians import Gaussians

FloatArray = NDArray[np.float64]

VIEWS = 40
ELEVATIONS = (-5.0, 10.0, 25.0)
"""Degrees above the middle of the subject of the rings of cameras."""
WIDTH, HEIGHT = 640, 480
VIEW_ANGLE = 45.0
"""Degrees across the shorter side of a picture."""
MARGIN = 1.15
"""Radii of the subject in half of the shorter side of a picture."""
LEAST_OPACITY = 0.1


@dataclass(frozen=True, eq=False)
class Subject:
    """The sphere around what was photographed in most detail. center: (3,) and radius in scene units."""

    center: FloatArray
    radius: float


def find_subject(gaussians: Gaussians) -> Subject:
    """The sphere around most of the detail: small opaque Gaussians count most, distant ones (sky, haze) almost nothing.

    Each Gaussian weighs opacity ÷ size. Middle and spread are weighted medians, computed again from what lies within
    three of the earlier spreads until they no longer change.
    """
    means = gaussians.means.detach().double().numpy()
    weights = (gaussians.opacities / gaussians.scales.amax(1)).detach().double().numpy()
    weights = np.where(gaussians.opacities.detach().numpy() >= LEAST_OPACITY, weights, 0.0)
    if not weights.any():
        weights = np.ones(len(means))
    near = np.ones(len(means), bool)
    for _ in range(20):
        center = np.array([weighted_quantile(column, weights[near], 0.5) for column in means[near].T])
        distances = np.linalg.norm(means - center, axis=1)
        spread = weighted_quantile(distances[near], weights[near], 0.5)
        closer = distances <= 3.0 * spread
        if np.array_equal(closer, near):
            break
        near = closer
    return Subject(center, weighted_quantile(distances[near], weights[near], 0.95))


def weighted_quantile(values: FloatArray, weights: FloatArray, share: float) -> float:
    """The least of `values` (N,) at which their summed `weights` reach `share` of the total."""
    order = np.argsort(values, kind="stable")
    summed = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(summed, share * summed[-1])), len(order) - 1)]])


def cameras_around(subject: Subject, up: FloatArray) -> list[Camera]:
    """VIEWS cameras on rings about `up` that all look at the middle of the subject and show all of it."""
    focal = 0.5 * min(WIDTH, HEIGHT) / math.tan(math.radians(VIEW_ANGLE) / 2)
    K = np.array([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]])
    distance = MARGIN * subject.radius / math.sin(math.radians(VIEW_ANGLE) / 2)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    ahead = np.cross(up, side)
    cameras = []
    for index in range(VIEWS):
        rise = math.radians(ELEVATIONS[index % len(ELEVATIONS)])
        turn = 2.0 * math.pi * index / VIEWS
        away = math.cos(rise) * (math.cos(turn) * side + math.sin(turn) * ahead) + math.sin(rise) * up
        pose = look_along(subject.center + distance * away, -away, up)
        cameras.append(Camera(K=K, world_to_camera=pose, width=WIDTH, height=HEIGHT))
    return cameras
