"""Pictures of a bumpy wall with noise on it, from points on an arc."""

from __future__ import annotations

import functools

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0


def center(view: float) -> np.ndarray:
    """(3,) where view `view` of the walk stands: on an arc about the origin, at two heights."""
    angle = np.radians(9.0 * view)
    return np.array([4.0 * np.sin(angle), 0.5 * (view % 2), -4.0 * np.cos(angle)])


@functools.cache
def texture() -> np.ndarray:
    noise = np.random.default_rng(0).normal(size=(1024, 1024))
    return gaussian_filter(noise, 2.0, mode="wrap") * 12 + gaussian_filter(noise, 8.0, mode="wrap") * 40


def render(view: float) -> Image.Image:
    """The wall seen from `center(view)`."""
    eye = center(view)
    return picture(eye, -eye / np.linalg.norm(eye))


def pass_by(view: float) -> Image.Image:
    """The wall seen from a walk along it."""
    return picture(np.array([0.4 * view - 1.0, 0.2 * (view % 2), -4.0]), np.array([0.0, 0.0, 1.0]))


def picture(eye: np.ndarray, forward: np.ndarray) -> Image.Image:
    """What a camera at `eye` shows: every pixel's ray meets z = 0.3·sin(2x)·cos(2y)."""
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5 - WIDTH / 2, np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    rays = (x[..., None] * right + y[..., None] * np.cross(forward, right)) / FOCAL + forward
    depth = -eye[2] / rays[..., 2]
    for _ in range(20):
        point = eye + depth[..., None] * rays
        depth = (0.3 * np.sin(2 * point[..., 0]) * np.cos(2 * point[..., 1]) - eye[2]) / rays[..., 2]
    column, row = (np.rint(point[..., k] * 90 + 512).astype(int) % 1024 for k in (0, 1))
    return Image.fromarray(np.clip(128 + 110 * texture()[row, column], 0, 255).astype(np.uint8)).convert("RGB")
