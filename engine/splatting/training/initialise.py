"""The first Gaussians: the sparse cloud, random points where it is too sparse, and a dome for the distant
background."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import TrainingError
from ...scene.camera import Scene, axes_equations
from ..gaussians import Gaussians, make_round_gaussians
from .photos import PhotoShelf

FEWEST_POINTS = 2000
"""With fewer sparse points than this, random points are added."""
DOME_POINTS = 3000
START_OPACITY = 0.1
Points = NDArray[np.float64]


def initialise_gaussians(shelf: PhotoShelf, views: Sequence[int], sh_degree: int, limit: int, seed: int) -> Gaussians:
    """Make at most `limit` isotropic Gaussians to start training from, coloured by the cloud or by the photos of
    `views`.

    Sparse points get the mean distance of their three nearest neighbours as size (3DGS). A scene with fewer than 2,000
    of them gets random points in the sphere that the cameras look at. Anything farther away than all points (sky,
    hills) starts on a sphere around the scene, if a training photo shows it.

    Raises:
        TrainingError: no camera sees any of the points, those of the cloud or those added.
        SceneError: a photo cannot be read, or its size is not its camera's.
    """
    scene = shelf.scene
    random = np.random.default_rng([seed, 0x1717])
    points, colors = np.asarray(scene.points, np.float64), scene.colors / 255.0
    finite = np.isfinite(points).all(1)
    points, colors = points[finite], colors[finite]
    if len(points) > 0 and not _is_seen_by_any(shelf, views, points):
        raise TrainingError(
            f"None of the {len(points):,} sparse points lies before any camera. The model's poses and points do not"
            " belong together"
        )
    dome = _make_dome(scene, points, min(DOME_POINTS, limit // 4))
    dome_colors, seen = _colors_in_photos(shelf, views, dome)
    dome, dome_colors = dome[seen], dome_colors[seen]
    room = max(limit - len(dome), 1)
    if len(points) < min(FEWEST_POINTS, room):
        center, radius = _find_focus(scene)
        extra = center + radius * _sample_ball(random, min(FEWEST_POINTS, room) - len(points))
        extra_colors, seen = _colors_in_photos(shelf, views, extra)
        points, colors = np.concatenate([points, extra[seen]]), np.concatenate([colors, extra_colors[seen]])
    if len(points) + len(dome) == 0:
        raise TrainingError("No camera sees any part of the scene. Check the model's poses")
    if len(points) > room:
        kept = np.sort(random.choice(len(points), room, replace=False))
        points, colors = points[kept], colors[kept]
    sizes = np.concatenate([neighbour_distances(points), neighbour_distances(dome)])
    return make_round_gaussians(
        np.concatenate([points, dome]),
        sizes,
        np.concatenate([colors, dome_colors]),
        opacity=START_OPACITY,
        sh_degree=sh_degree,
    )


def neighbour_distances(points: Points) -> NDArray[np.float64]:
    """(P,) root mean square distance to the three nearest neighbours."""
    if len(points) < 2:
        return np.ones(len(points))
    distances = cKDTree(points).query(points, k=min(4, len(points)))[0][:, 1:]
    return np.maximum(np.sqrt((distances**2).mean(1)), 1e-7)


def _find_focus(scene: Scene) -> tuple[Points, float]:
    """Find centre and radius of the sphere that the cameras look at: the point nearest to all viewing axes.

    For parallel axes that point is undefined; a weight of 1 % on the middle of the cameras, one camera spread ahead,
    settles it.
    """
    cameras = scene.cameras
    centers = np.stack([camera.center for camera in cameras])
    axes = np.stack([camera.forward for camera in cameras])
    guess = centers.mean(0) + axes.mean(0) * scene.spread
    left, right = axes_equations(cameras)
    weight = 0.01 * len(cameras)
    center = np.linalg.solve(left + weight * np.eye(3), right + weight * guess)
    return center, 0.7 * float(np.linalg.norm(centers - center, axis=1).mean())


def _sample_ball(random: np.random.Generator, n: int) -> Points:
    directions = random.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * random.random((n, 1)) ** (1 / 3)


def _make_dome(scene: Scene, points: Points, n: int) -> Points:
    """Make n evenly spread points on a sphere well beyond the cameras and nearly all sparse points (Fibonacci's
    lattice)."""
    center, reach = scene.middle, scene.extent
    if len(points) > 0:
        reach = max(reach, float(np.quantile(np.linalg.norm(points - center, axis=1), 0.98)))
    k = np.arange(n) + 0.5
    height = 1.0 - 2.0 * k / max(n, 1)
    turn = math.pi * (1.0 + math.sqrt(5.0)) * k
    ring = np.sqrt(1.0 - height**2)
    return center + 4.0 * reach * np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)


def _is_seen_by_any(shelf: PhotoShelf, views: Sequence[int], points: Points) -> bool:
    return any(shelf.scene.cameras[view].find_in_frame(points)[0].any() for view in views)


def _colors_in_photos(shelf: PhotoShelf, views: Sequence[int], points: Points) -> tuple[Points, NDArray[np.bool_]]:
    """(P, 3) mean colour of the usable pixels that points project to, and (P,) whether any photo has such a pixel."""
    sums = np.zeros((len(points), 3))
    counts = np.zeros(len(points))
    for view in views[:: max(len(views) // 40, 1)]:
        inside, places, _ = shelf.scene.cameras[view].find_in_frame(points)
        if inside.any():
            picture = shelf.picture(view)
            column, row = places[inside].astype(int).T
            if picture.mask is not None:
                inside[inside] = picture.mask[row, column]
                column, row = places[inside].astype(int).T
            sums[inside] += picture.pixels[row, column] / 255.0
            counts[inside] += 1
    return sums / np.maximum(counts, 1)[:, None], counts > 0
