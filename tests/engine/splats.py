"""Small made-up Gaussians, cameras and scenes for the tests of splatting."""

from __future__ import annotations

import math

import numpy as np
import torch

from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.splatting.gaussians import Gaussians
from fruitlangs.engine.splatting.rendering.rasterize import render


def random_gaussians(n: int, degree: int, seed: int = 0, *, log_scale: float = -2.5) -> Gaussians:
    """Gaussians around the origin in float32, with quaternions that are not of unit length."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    return Gaussians(
        means=normal(n, 3),
        log_scales=normal(n, 3) * 0.5 + log_scale,
        quats=normal(n, 4),
        opacity_logits=normal(n) * 1.5,
        sh=normal(n, (degree + 1) ** 2, 3) * 0.3,
    )


def ring_camera(angle: float = 0.3, *, width: int = 70, height: int = 50, focal: float = 60.0) -> Camera:
    """A camera four units from the origin that looks at it, turned about y, with unequal focal lengths."""
    pose = np.eye(4)
    pose[:3, :3] = [
        [math.cos(angle), 0.0, math.sin(angle)],
        [0.0, 1.0, 0.0],
        [-math.sin(angle), 0.0, math.cos(angle)],
    ]
    pose[:3, 3] = [0.1, -0.2, 4.0]
    K = np.array([[focal, 0.0, width / 2 + 1.3], [0.0, focal * 1.1, height / 2 - 0.7], [0.0, 0.0, 1.0]])
    return Camera(K=K, world_to_camera=pose, width=width, height=height)


def drawn_scene(views: int = 8, *, n: int = 60, seed: int = 5, width: int = 64, height: int = 48) -> Scene:
    """Photos of random Gaussians from all around, with their means as the sparse cloud."""
    gaussians = random_gaussians(n, 0, seed, log_scale=-1.7)
    gaussians.opacity_logits.add_(2.0)
    cameras = [ring_camera(2 * math.pi * k / views, width=width, height=height) for k in range(views)]
    photos = []
    for k, camera in enumerate(cameras):
        color = render(gaussians, camera, background=torch.tensor([0.3, 0.5, 0.7])).color
        photos.append(ArrayPhoto(f"{k:03d}.png", (color.clamp(0, 1) * 255).round().to(torch.uint8).numpy()))
    return Scene(
        cameras=cameras,
        images=photos,
        points=gaussians.means.double().numpy(),
        colors=(gaussians.base_colors * 255).to(torch.uint8).numpy(),
        up=np.array([0.0, -1.0, 0.0]),
    )
