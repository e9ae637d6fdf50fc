"""Rows of simulated trees in any direction and on any terrain, without a rendered photo: fruit, cameras, depths and
Gaussians follow from a few spheres. Lengths are in meters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fruitlangs.engine.counting.evidence.visibility import Picture
from fruitlangs.engine.scene.camera import Camera, look_along
from fruitlangs.engine.splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]
Terrain = Callable[[FloatArray, FloatArray], FloatArray]
"""Heights (N,) of the ground at places (N,) along and (N,) across the row."""

SPACING, CROWN, CORE, TRUNK = 2.5, 1.0, 0.7, 1.6
"""Distance between trees; radius of a crown, and of its opaque core; height of its middle above the ground."""
DIAMETER, FRUIT, FALLEN = 0.08, 40, 4
"""Of a fruit; number of fruit that hang on a tree, and that lie below it."""
AWAY, EYES = 2.5, 4
"""Distance of the cameras from the row; number of cameras on each side of a tree."""
DIRECTIONS = {
    "x": np.array([1.0, 0.0, 0.0]),
    "y": np.array([0.0, 1.0, 0.0]),
    "diagonal": np.full(3, 3**-0.5),
    "slope": np.array([1.0, 0.0, 0.0]),
}


def level(along: FloatArray, across: FloatArray) -> FloatArray:
    return 0.0 * along


def hilly(along: FloatArray, across: FloatArray) -> FloatArray:
    """Rises by an eighth along the row, over a hill 1 m high every 40 m, and falls by a tenth across it."""
    return 0.125 * along - 0.1 * across + 0.5 * np.sin(along * 2.0 * np.pi / 40.0)


@dataclass(frozen=True, eq=False)
class Row:
    """centers: (F, 3) of the fruit; fallen: (F,) whether each lies on the ground; heights: (F,) of its center above its
    foot; gaussians: of ground and leaves; up: (3,) unit; trees: (T, 3) middles of the crowns."""

    centers: FloatArray
    fallen: NDArray[np.bool_]
    heights: FloatArray
    gaussians: Gaussians
    cameras: list[Camera]
    up: FloatArray
    trees: FloatArray

    @property
    def pictures(self) -> list[Picture]:
        """Depths of the opaque cores of the nearest trees."""
        return [_picture(camera, self.trees) for camera in self.cameras]


def frame_along(direction: FloatArray) -> FloatArray:
    """(3, 3) columns: along the row, across it, up."""
    side = np.cross([0.0, 0.0, 1.0], direction)
    side /= np.linalg.norm(side)
    return np.stack([direction, side, np.cross(direction, side)], axis=1)


def simulate_row(trees: int, direction: str = "x", terrain: Terrain | None = None, seed: int = 0) -> Row:
    """A row whose cameras walk along both of its sides."""
    rng = np.random.default_rng(seed)
    ground = terrain or (hilly if direction == "slope" else level)
    frame = frame_along(DIRECTIONS[direction])
    stems = SPACING * np.arange(trees)
    middles = np.stack([stems, 0.0 * stems, ground(stems, 0.0 * stems) + TRUNK], axis=1)

    hanging = np.repeat(middles, FRUIT, axis=0) + _shell(rng, FRUIT * trees, CORE)
    lying = np.repeat(stems, FALLEN) + rng.uniform(-0.9, 0.9, FALLEN * trees)
    aside = rng.uniform(-0.9, 0.9, FALLEN * trees)
    dropped = np.stack([lying, aside, ground(lying, aside) + 0.5 * DIAMETER], axis=1)
    centers = np.concatenate([hanging, dropped])
    heights = centers[:, 2] - ground(centers[:, 0], centers[:, 1])

    x, y = rng.uniform(-AWAY, stems[-1] + AWAY, 1200 * trees + 1200), rng.uniform(-AWAY, AWAY, 1200 * trees + 1200)
    lawn = np.stack([x, y, ground(x, y) + rng.normal(0.0, 0.01, len(x))], axis=1)
    leaves = np.repeat(middles, 800, axis=0) + _shell(rng, 800 * trees, 0.3)
    means = np.concatenate([lawn, leaves]) @ frame.T
    widths = np.repeat([0.06, 0.03], [len(lawn), len(leaves)])
    return Row(
        centers @ frame.T,
        np.repeat([False, True], [len(hanging), len(dropped)]),
        heights,
        _gaussians(means, widths),
        _cameras(trees, ground, frame),
        frame[:, 2],
        middles @ frame.T,
    )


def _shell(rng: np.random.Generator, count: int, inner: float) -> FloatArray:
    """(count, 3) places spread evenly over a ball of radius CROWN without its inner part."""
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return CROWN * directions * np.cbrt(rng.uniform(inner**3, 1.0, (count, 1)))


def _gaussians(means: FloatArray, widths: FloatArray) -> Gaussians:
    count = len(means)
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        log_scales=torch.tensor(np.log(widths), dtype=torch.float32)[:, None].repeat(1, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.full((count,), 3.0),
        sh=torch.zeros(count, 1, 3),
    )


def _cameras(trees: int, ground: Terrain, frame: FloatArray) -> list[Camera]:
    K = np.array([[40.0, 0.0, 24.0], [0.0, 40.0, 18.0], [0.0, 0.0, 1.0]])
    along = SPACING / EYES * (np.arange(EYES * trees) - (EYES - 1) / 2.0)
    cameras = []
    for side in (-AWAY, AWAY):
        for place in along:
            here = np.array([place])
            eye = np.array([place, side, float(ground(here, np.array([side]))[0]) + TRUNK])
            aim = np.array([place, 0.0, float(ground(here, np.zeros(1))[0]) + TRUNK])
            cameras.append(Camera(K, look_along(frame @ eye, frame @ (aim - eye), frame[:, 2]), 48, 36))
    return cameras


def _picture(camera: Camera, trees: FloatArray) -> Picture:
    """The depth along the optical axis of the cores of the trees near a camera."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([(columns - camera.K[0, 2]) / camera.K[0, 0], (rows - camera.K[1, 2]) / camera.K[1, 1]], axis=-1)
    rays = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    depth = np.full(rays.shape[:2], 1e9)
    squares = (rays**2).sum(axis=-1)
    for tree in cKDTree(trees).query_ball_point(camera.center, 4.0 * SPACING):
        middle = camera.world_to_camera[:3, :3] @ trees[tree] + camera.world_to_camera[:3, 3]
        ahead = rays @ middle
        root = ahead**2 - squares * (middle @ middle - CORE**2)
        hit = (ahead - np.sqrt(np.maximum(root, 0.0))) / squares
        depth = np.where((root > 0.0) & (hit > 0.0), np.minimum(depth, hit), depth)
    return Picture(camera, depth.astype(np.float32), np.zeros(depth.shape, np.float32))
