"""Chooses the photos with the best view of a fruit: whole, not behind leaves, large and near the middle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...engine.language.teaching.ray_hits import LEAST_ALPHA, SIGMAS, FloatArray, pick_surface
from ...engine.scene.camera import Camera

SAMPLES = 6
"""Points tested on the disc of a fruit, in addition to its centre."""
SAMPLE_RADIUS = 0.65
"""Their distance from the centre, in radii."""
OUTLINE = 24
"""Points tested on the outline of a fruit, which the frame must not cut."""
CORNER_WEIGHT = 0.5
"""Weight of a view in the corner of a photo relative to one in its middle, where lenses are sharpest."""
FRONT = 1.3
"""Whatever stops the light nearer than this, in radii before the centre, is another object."""
MOST = 24
"""Number of photos for which occlusion by the Gaussians is tested, best first; more only if those do not show the
fruit."""
LEAST_SHARE = 0.1
"""Least visible share of the tested points; a photo below it does not show the fruit."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Occluding Gaussians: means (N, 3), scales (N, 3), quats (N, 4) w first, opacities (N,); in the scene frame."""

    means: FloatArray
    scales: FloatArray
    quats: FloatArray
    opacities: FloatArray

    def __len__(self) -> int:
        return len(self.means)

    def select_along(self, origin: NDArray[np.float64], center: NDArray[np.float64], radius: float) -> Surface:
        """Select those that can hide a sphere from a position: in the cone between both, or reaching into it."""
        distance = float(np.linalg.norm(center - origin))
        offsets = self.means - origin.astype(self.means.dtype)
        depth = offsets @ ((center - origin) / distance).astype(self.means.dtype)
        apart = np.sqrt(np.maximum(np.einsum("ij,ij->i", offsets, offsets) - depth**2, 0.0))
        reach = SIGMAS * self.scales.max(axis=1, initial=0.0)
        cone = radius * np.maximum(depth, 0.0) / distance
        near = (depth > -reach) & (depth < distance + radius + reach) & (apart < cone + reach)
        near &= self.opacities >= LEAST_ALPHA
        return Surface(self.means[near], self.scales[near], self.quats[near], self.opacities[near])


@dataclass(frozen=True, eq=False)
class Sight:
    """The view of a fruit in one photo.

    index: of the camera; place: (2,) pixel of the centre of the fruit; pixels: its diameter in the photo; share: of it
    that is inside the frame and not hidden, 0 to 1; whole: whether the frame does not cut it; off_center: distance from
    the middle of the photo, 1 in its corners.
    """

    index: int
    place: NDArray[np.float64]
    pixels: float
    share: float
    whole: bool
    off_center: float

    @property
    def rank(self) -> tuple[bool, float, int]:
        """Smallest for the best view: one that is not cut, then the most visible, largest and most central one.

        The visible share counts like the diameter, so that a view twice as large with a third of the fruit comes after
        the open one.
        """
        weight = 1.0 - (1.0 - CORNER_WEIGHT) * self.off_center**2
        return not self.whole, -weight * (self.share * self.pixels) ** 2, self.index


def find_best_views(
    cameras: Sequence[Camera], center: NDArray[np.float64], axes: NDArray[np.float64], surface: Surface | None
) -> list[Sight]:
    """Find the photos that show an ellipsoid, best first; empty if none does.

    center: (3,); axes: (3, 3) its half axes as rows; surface: None hides nothing.
    """
    radius = float(np.linalg.norm(axes, axis=1).mean())
    framed = [_measure_in_frame(index, camera, center, axes) for index, camera in enumerate(cameras)]
    seen: list[Sight] = []
    for tested, sight in enumerate(sorted((one for one in framed if one.share > 0.0), key=lambda one: one.rank)):
        if tested >= MOST and seen:
            break
        if surface is not None and len(surface):
            sight = replace(sight, share=_measure_open_share(cameras[sight.index], center, radius, surface))
        if sight.share >= LEAST_SHARE:
            seen.append(sight)
    return sorted(seen, key=lambda sight: sight.rank)


def _measure_in_frame(index: int, camera: Camera, center: NDArray[np.float64], axes: NDArray[np.float64]) -> Sight:
    """Measure the view of an ellipsoid in a camera without occluders."""
    radius = float(np.linalg.norm(axes, axis=1).mean())
    inside = _find_in_frame(camera, _sample_disc(camera, center, radius))
    place, depth = camera.project(center)
    pixels = 2.0 * radius * float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])) / max(float(depth), 1e-12)
    share = float(inside.mean()) if depth > radius else 0.0
    whole = share > 0.0 and bool(_find_in_frame(camera, _compute_outline(camera, center, axes)).all())
    size = np.array([camera.width, camera.height])
    off_center = float(np.linalg.norm(place - 0.5 * size) / np.linalg.norm(0.5 * size))
    return Sight(index, place, pixels, share, whole, min(off_center, 1.0))


def _compute_outline(camera: Camera, center: NDArray[np.float64], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the points (OUTLINE, 3) where the rays of a camera touch an ellipsoid; its half axes if the camera is
    inside.

    In units of the half axes it is the unit sphere, which is touched on a circle.
    """
    origin = np.linalg.solve(axes.T, camera.center - center)
    distance = float(np.linalg.norm(origin))
    if distance <= 1.0:
        return np.concatenate([center + axes, center - axes])
    along = origin / distance
    right = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    right /= np.linalg.norm(right)
    angles = 2.0 * np.pi * np.arange(OUTLINE) / OUTLINE
    around = np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * np.cross(along, right)
    circle = along / distance + np.sqrt(1.0 - distance**-2) * around
    return np.asarray(center + circle @ axes)


def _measure_open_share(camera: Camera, center: NDArray[np.float64], radius: float, surface: Surface) -> float:
    """Measure the share of a sphere's disc that is inside the frame and not hidden by Gaussians."""
    places = _sample_disc(camera, center, radius)
    near = surface.select_along(camera.center, center, radius)
    open_ones = 0
    for place in places[_find_in_frame(camera, places)]:
        along = place - camera.center
        distance = float(np.linalg.norm(along))
        hit = pick_surface(
            camera.center, along / distance, near.means, near.scales, near.quats, near.opacities
        )  # None: no occluder, not even the surface of the fruit
        open_ones += hit is None or float(np.linalg.norm(hit - camera.center)) > distance - FRONT * radius
    return open_ones / len(places)


def _sample_disc(camera: Camera, center: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """Return (SAMPLES + 1, 3) the centre of a sphere and points around it, on the disc that faces the camera."""
    along = (center - camera.center) / max(float(np.linalg.norm(center - camera.center)), 1e-12)
    right = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    right /= np.linalg.norm(right)
    turns = 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES
    around = np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * np.cross(along, right)
    return np.concatenate([center[None], center + SAMPLE_RADIUS * radius * around])


def _find_in_frame(camera: Camera, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Find (P,) whether points (P, 3) are inside the camera's frame."""
    pixels, depths = camera.project(places)
    inside = ((pixels >= 0.0) & (pixels <= [camera.width, camera.height])).all(axis=1)
    return np.asarray(inside & (depths > 0.0))
