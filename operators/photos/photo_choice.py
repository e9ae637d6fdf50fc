"""Chooses the photos with the best view of a fruit: large, inside the frame and not behind leaves."""

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
FRONT = 1.3
"""Whatever stops the light nearer than this, in radii before the centre, is another object."""
MOST = 24
"""Number of photos for which occlusion by the Gaussians is tested: those that show the fruit largest."""
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

    def along(self, origin: NDArray[np.float64], center: NDArray[np.float64], radius: float) -> Surface:
        """Those that can hide a sphere from a position: in the cone between both, or reaching into it."""
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
    that is inside the frame and not hidden, 0 to 1.
    """

    index: int
    place: NDArray[np.float64]
    pixels: float
    share: float

    @property
    def score(self) -> float:
        """Visible pixels of the fruit, as an area."""
        return self.share * self.pixels**2


def best_sights(
    cameras: Sequence[Camera], center: NDArray[np.float64], radius: float, surface: Surface | None
) -> list[Sight]:
    """The photos that show a sphere at center (3,), best first; empty if none does. surface: None hides nothing."""
    framed = [sight for sight in (_in_frame(*each, center, radius) for each in enumerate(cameras)) if sight.share > 0.0]
    largest = sorted(framed, key=lambda sight: -sight.score)[:MOST]
    if surface is not None and len(surface):
        largest = [
            replace(sight, share=_open_share(cameras[sight.index], center, radius, surface)) for sight in largest
        ]
    seen = [sight for sight in largest if sight.share >= LEAST_SHARE]
    return sorted(seen, key=lambda sight: (-sight.score, sight.index))


def _in_frame(index: int, camera: Camera, center: NDArray[np.float64], radius: float) -> Sight:
    """The view of a sphere in a camera without occluders."""
    inside = _framed(camera, _disc(camera, center, radius))
    place, depth = camera.project(center)
    pixels = 2.0 * radius * float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])) / max(float(depth), 1e-12)
    return Sight(index, place, pixels, float(inside.mean()) if depth > radius else 0.0)


def _open_share(camera: Camera, center: NDArray[np.float64], radius: float, surface: Surface) -> float:
    """Share of a sphere's disc that is inside the frame and not hidden by Gaussians."""
    places = _disc(camera, center, radius)
    near = surface.along(camera.center, center, radius)
    open_ones = 0
    for place in places[_framed(camera, places)]:
        along = place - camera.center
        distance = float(np.linalg.norm(along))
        hit = pick_surface(
            camera.center, along / distance, near.means, near.scales, near.quats, near.opacities
        )  # None: no occluder, not even the surface of the fruit
        open_ones += hit is None or float(np.linalg.norm(hit - camera.center)) > distance - FRONT * radius
    return open_ones / len(places)


def _disc(camera: Camera, center: NDArray[np.float64], radius: float) -> NDArray[np.float64]:
    """(SAMPLES + 1, 3) the centre of a sphere and points around it, on the disc that faces the camera."""
    along = (center - camera.center) / max(float(np.linalg.norm(center - camera.center)), 1e-12)
    right = np.cross(along, np.eye(3)[np.argmin(np.abs(along))])
    right /= np.linalg.norm(right)
    turns = 2.0 * np.pi * np.arange(SAMPLES) / SAMPLES
    around = np.cos(turns)[:, None] * right + np.sin(turns)[:, None] * np.cross(along, right)
    return np.concatenate([center[None], center + SAMPLE_RADIUS * radius * around])


def _framed(camera: Camera, places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(P,) whether points (P, 3) are inside the camera's frame."""
    pixels, depths = camera.project(places)
    inside = ((pixels >= 0.0) & (pixels <= [camera.width, camera.height])).all(axis=1)
    return np.asarray(inside & (depths > 0.0))
