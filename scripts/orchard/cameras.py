"""The walk around the tree: one camera a picture, in COLMAP's convention (x right, y down, z forward)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .body import Body
from .config import OrchardConfig
from .species import Species
from .tree import unit

FloatArray = NDArray[np.float64]
NEAREST = 2.3
"""Distance of the walk from the tree's axis, in heights of the tree ÷ 2: far enough to keep clear of the crown."""


@dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """A pinhole camera. A pixel's centre lies at half-integers; the principal point is the picture's middle."""

    name: str
    """File name of its picture."""
    focal: float
    """In pixels."""
    width: int
    height: int
    world_to_camera: FloatArray
    """(3, 4) rotation and translation, metres."""
    nearest: float = 0.02
    """Anything closer is cut away, metres along the optical axis."""

    @property
    def position(self) -> FloatArray:
        """(3,) the camera's place in the world."""
        return -self.world_to_camera[:, :3].T @ self.world_to_camera[:, 3]

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(M, 2) pixels and (M,) depths of (M, 3) world points."""
        local = points @ self.world_to_camera[:, :3].T + self.world_to_camera[:, 3]
        middle = np.array([self.width / 2, self.height / 2])
        return local[:, :2] / local[:, 2:] * self.focal + middle, local[:, 2]

    def unproject(self, pixels: FloatArray, depths: FloatArray) -> FloatArray:
        """(M, 3) world points at depths (along the optical axis) behind (M, 2) pixels."""
        middle = np.array([self.width / 2, self.height / 2])
        rays = np.hstack([(pixels - middle) / self.focal, np.ones((len(pixels), 1))])
        return (rays * depths[:, None] - self.world_to_camera[:, 3]) @ self.world_to_camera[:, :3]


def look_at(position: FloatArray, target: FloatArray, roll: float = 0.0) -> FloatArray:
    """(3, 4) world_to_camera of a camera at `position` that sees `target` in its middle, z up in the world."""
    forward = unit(target - position)
    right = unit(np.cross(forward, [0.0, 0.0, 1.0]))
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    return np.hstack([rotation, (-rotation @ position)[:, None]])


def walk(rng: np.random.Generator, config: OrchardConfig, species: Species, crown: FloatArray) -> list[Viewpoint]:
    """Rings of cameras at evenly spread heights, jittered in place and aim. `crown` is (2, 3): low and high corner."""
    size = species.tree_height / 2.3
    middle = crown.mean(axis=0) + [0.0, 0.0, 0.05 * (crown[1, 2] - crown[0, 2])]
    distance = NEAREST * species.tree_height / 2
    focal = config.fruit_pixels * distance / species.diameter
    heights = middle[2] + (crown[1, 2] - crown[0, 2]) * np.linspace(-0.25, 0.55, config.rings)
    views = []
    for i in range(config.views):
        ring, step = i % config.rings, i // config.rings
        per_ring = -(-config.views // config.rings)
        turn = 2 * np.pi * (step + ring / config.rings + rng.uniform(-0.15, 0.15)) / per_ring
        away = distance * rng.uniform(0.95, 1.05)
        place = np.array([np.cos(turn) * away, np.sin(turn) * away, heights[ring] + rng.normal(0.0, 0.05) * size])
        place[:2] += middle[:2]
        target = middle + rng.normal(0.0, 0.05, 3) * size
        views.append(
            Viewpoint(
                name=f"{i + 1:03d}.jpg",
                focal=focal,
                width=config.width,
                height=config.height,
                world_to_camera=look_at(place, target, rng.normal(0.0, 0.01)),
            )
        )
    return views


def close_ups(
    rng: np.random.Generator, config: OrchardConfig, species: Species, crown: FloatArray, fruits: Sequence[Body]
) -> list[Viewpoint]:
    """Views from scattered distances, each aimed at a fruit; fruit span about 10 to 90 pixels; one focal length."""
    size = species.tree_height / 2.3
    middle = crown.mean(axis=0)
    focal = 1.15 * max(config.width, config.height)
    spans = np.geomspace(12.0, 80.0, config.views) * np.exp(rng.normal(0.0, 0.12, config.views))
    views = []
    for i, span in enumerate(spans):
        target = fruits[rng.integers(len(fruits))].center if fruits else middle
        outward = unit(np.array([*(target - middle)[:2], 0.0]) + rng.normal(0.0, 0.25, 3) * [1, 1, 0] * size + 1e-6)
        rise = np.tan(np.radians(rng.uniform(-22, 32)))
        distance = max(focal * species.diameter / span, 2.2 * species.diameter)
        place = target + unit(outward + [0, 0, rise]) * distance
        place[2] = max(place[2], 0.15 * size)
        aim = target + rng.normal(0.0, 0.25, 3) * species.diameter
        view = Viewpoint(
            name=f"{i + 1:03d}.jpg",
            focal=focal,
            width=config.width,
            height=config.height,
            world_to_camera=look_at(place, aim, rng.normal(0, 0.06)),
        )
        views.append(replace(view, nearest=_cut(view, 0.55 * distance, fruits)))
    return views


def _cut(view: Viewpoint, wanted: float, fruits: Sequence[Body]) -> float:
    """How much before the camera may be cut away, at most `wanted`, so that leaves there do not hide everything.

    Neither the ground nor a fruit is cut open.
    """
    corners = np.array([[x, y] for x in (0.0, view.width) for y in (0.0, view.height)])
    drops = (view.position - view.unproject(corners, np.ones(4)))[:, 2]
    ground = [0.75 * view.position[2] / drop for drop in drops if drop > 1e-6]
    nearest = min([wanted, *ground])
    depths = view.project(np.array([f.center for f in fruits]).reshape(-1, 3))[1]
    for depth, body in sorted(zip(depths, fruits, strict=True), key=lambda pair: -pair[0]):
        if abs(depth - nearest) < 1.1 * body.reach:
            nearest = depth - 1.1 * body.reach
    return float(max(nearest, 0.02))
