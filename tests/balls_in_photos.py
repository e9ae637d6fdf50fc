"""Photos of balls with exact offsets, as a network shows them: smoothed by the blur that is measured of it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from fruitlangs.engine.counting.evidence.visibility import Picture
from fruitlangs.engine.counting.geometry.sphere import unit_directions
from fruitlangs.engine.counting.photos.places import Places
from fruitlangs.engine.counting.photos.surroundings import Surroundings
from fruitlangs.engine.counting.photos.verifier import Verifier, load_networks
from fruitlangs.engine.counting.photos.views import BLUR, PhotoViews
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap
from fruitlangs.engine.scene.camera import Camera, look_along
from fruitlangs.engine.splatting.gaussians import Gaussians

FOCAL, AWAY, WALL = 260.0, 2.0, 6.0
WIDTH, HEIGHT = 240, 240


def camera_at(turn: float, height: float = 0.0) -> Camera:
    eye = AWAY * np.array([np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)])
    K = np.array([[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return Camera(width=WIDTH, height=HEIGHT, K=K, world_to_camera=look_along(eye, -eye, np.array([0.0, 0.0, 1.0])))


RING = [camera_at(turn, 0.5 * (-1) ** index) for index, turn in enumerate(np.arange(16) * np.pi / 8)]


def photo_of(camera: Camera, balls: Places) -> tuple[Picture, PhotoMap]:
    """The rendered depth of balls before a wall, and the map of a photo of the same size that shows them."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    depth, offsets = np.full(u.shape, WALL), np.zeros((*u.shape, 2))
    pose = camera.world_to_camera[:3]
    (fx, _, cx), (_, fy, cy), _ = camera.K
    for (x, y, z), radius in zip(balls.centers @ pose[:, :3].T + pose[:, 3], balls.radii, strict=True):
        aside = np.stack([u - cx - fx * x / z, v - cy - fy * y / z], axis=-1)
        pixels = np.array([fx, fy]) * radius / z
        squared = ((aside / pixels) ** 2).sum(axis=-1)
        front = z - radius * np.sqrt(np.maximum(1.0 - squared, 0.0))
        own = (squared < 1.0) & (front < depth)
        depth[own], offsets[own] = front[own], (aside / np.sqrt(pixels**2 + BLUR**2))[own]
    shown = (depth < WALL).astype(np.float32)
    return Picture(camera, depth.astype(np.float32), shown), PhotoMap(shown, offsets.astype(np.float32))


def views_of(balls: Places, cameras: list[Camera] = RING) -> PhotoViews:
    pictures, maps = zip(*(photo_of(camera, balls) for camera in cameras), strict=True)
    return PhotoViews.of(pictures, maps)


def surroundings_of(balls: Places, on_surfaces: NDArray, diameter: float) -> Surroundings:
    """Gaussians on the balls, all of which match the prompt. on_surfaces: (F, 3) fruit that were found on them."""
    directions = unit_directions(60)
    means = (balls.centers[:, None] + balls.radii[:, None, None] * directions).reshape(-1, 3)
    gaussians = Gaussians(
        means=torch.from_numpy(means),
        log_scales=torch.full((len(means), 3), -4.0),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1),
        opacity_logits=torch.full((len(means),), 2.0),
        sh=torch.zeros(len(means), 1, 3),
    )
    return Surroundings.of(gaussians, np.ones(len(means)), on_surfaces, diameter, 0.5)


def verifier_of(balls: Places, diameter: float, *, every: int = 2) -> Verifier:
    """diameter: of the fruit that were found on surfaces: one of so many balls."""
    return Verifier(load_networks(), views_of(balls), surroundings_of(balls, balls.centers[::every], diameter))


def balls_of(radii: NDArray, *, gap: float = 1.25, seed: int = 0) -> Places:
    """Balls of these radii (C,) around the origin, `gap` mean diameters or more from each other."""
    rng, centers = np.random.default_rng(seed), np.zeros((0, 3))
    for number, radius in enumerate(radii):
        while len(centers) == number:
            center = rng.uniform(-0.55, 0.55, 3)
            if (np.linalg.norm(centers - center, axis=1) > gap * (radii[:number] + radius)).all():
                centers = np.concatenate([centers, center[None]])
    return Places(centers, radii)
