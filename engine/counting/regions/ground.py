"""Distinguishes fallen from hanging fruit by their height above the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...scene.camera import Camera
from ...splatting.gaussians import Gaussians
from ...splatting.subject.ground import REACH, Plane, ground_plane
from ...splatting.subject.viewpoints import Subject

FloatArray = NDArray[np.float64]

FALLEN = 0.5
"""Median diameters above the ground below which a fruit on it has its lowest point. Measured on true surfaces and on
trained Gaussians of 5 scenes: fallen fruit up to 0.34, hanging ones from 2.6."""
NEARNESS = 0.5
"""Radius of the subject relative to the distance from which it was photographed."""
AROUND = 0.15
"""Radii of the subject around the foot of a fruit within which the height of the ground is estimated."""
RELIEF = 0.12
"""Radii of the subject by which the ground may deviate from its plane."""
LEAST_OPACITY = 0.3
FEWEST = 10
"""Gaussians needed for the height of the ground under a fruit."""


def lying_on_ground(
    gaussians: Gaussians, cameras: Sequence[Camera], centers: FloatArray, diameters: FloatArray, up: FloatArray
) -> list[bool | None]:
    """Whether each of F fruit lies on the ground; None if no ground is visible.

    The ground is a plane that may slope, corrected by the surface near the foot of each fruit. Far away, where only
    the plane continues, the result is None.

    Args:
        gaussians: those that are not fruit.
        centers: (F, 3) of the fruit, diameters: (F,), both in scene units.
        up: (3,) unit, away from the ground, roughly.
    """
    if len(centers) == 0 or len(gaussians) == 0:
        return [None] * len(centers)
    middle = np.median(centers, axis=0)
    distances = [float(np.linalg.norm(camera.center - middle)) for camera in cameras]
    subject = Subject(middle, NEARNESS * float(np.median(distances)))
    plane = ground_plane(gaussians, subject, up=up)
    if plane is None:
        return [None] * len(centers)
    relief = _relief(gaussians, plane, centers, subject.radius)
    far = np.linalg.norm(centers - middle, axis=1) > REACH * subject.radius
    lowest: FloatArray = plane.above(centers) - 0.5 * diameters - np.nan_to_num(relief)
    lying = (lowest < FALLEN * np.median(diameters)).tolist()
    unknown = (far & np.isnan(relief)).tolist()
    return [None if lost else low for lost, low in zip(unknown, lying, strict=True)]


def _relief(gaussians: Gaussians, plane: Plane, centers: FloatArray, radius: float) -> FloatArray:
    """(F,) height of the ground above its plane under each centre (F, 3), NaN if too little of it is visible.

    radius: of the subject, scene units.
    """
    means = gaussians.means.detach().double().cpu().numpy()
    above = plane.above(means)
    near = (np.abs(above) < RELIEF * radius) & (gaussians.opacities.detach().cpu().numpy() >= LEAST_OPACITY)
    means, above = means[near], above[near]
    feet = centers - plane.above(centers)[:, None] * plane.normal
    around = cKDTree(means - above[:, None] * plane.normal).query_ball_point(feet, AROUND * radius)
    return np.array([np.median(above[own]) if len(own) >= FEWEST else np.nan for own in around])
