"""Which cameras saw each Gaussian, and how much of each fruit: by the blending weights and depths of rendered views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..progress import Progress, silent
from ..scene.camera import Camera
from ..splatting.gaussians import Gaussians
from ..splatting.rasterize import accumulate, render

FloatArray = NDArray[np.float64]

SEEN_WEIGHT = 0.3
"""Summed blending weight in pixels from which a view counts as seeing a Gaussian."""


@dataclass(frozen=True, eq=False)
class Visibility:
    """How the views see N Gaussians.

    weights: (N,) pixels drawn by each Gaussian, summed over views; views: (N,) views that see it;
    directions: (N, 3) weighted mean of the unit directions towards the seeing cameras, zero where none sees it. Its
    length tells how alike these directions are.
    """

    weights: FloatArray
    views: NDArray[np.int64]
    directions: FloatArray


def see(gaussians: Gaussians, cameras: Sequence[Camera], *, progress: Progress = silent) -> Visibility:
    """Sum every view's blending weights α·T into the Gaussians that drew its pixels."""
    means = gaussians.means.detach().double().cpu().numpy()
    weights, views = np.zeros(len(means)), np.zeros(len(means), np.int64)
    directions = np.zeros((len(means), 3))
    for index, camera in enumerate(cameras):
        progress(index / len(cameras), f"seeing from view {index + 1} of {len(cameras)}")
        ones = torch.ones(camera.height, camera.width, 1)
        drawn = accumulate(gaussians, camera, ones).weights.detach().double().cpu().numpy()
        towards = camera.center - means
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        weights += drawn
        views += drawn > SEEN_WEIGHT
        directions += drawn[:, None] * towards
    return Visibility(weights, views, directions / np.maximum(weights, 1e-12)[:, None])


def visible_fractions(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    centers: FloatArray,
    diameters: FloatArray,
    *,
    progress: Progress = silent,
) -> FloatArray:
    """Largest share over views of each sphere's disc that has nothing in front of it.

    centers: (F, 3), diameters: (F,) scene units. Returns (F,) in [0, 1]; NaN for a sphere that no view frames whole.
    """
    best = np.full(len(centers), np.nan)
    if len(centers) == 0:
        return best
    for index, camera in enumerate(cameras):
        progress(index / len(cameras), f"measuring what view {index + 1} of {len(cameras)} sees of the fruit")
        rendered = render(gaussians, camera)
        depth = rendered.depth.detach().double().cpu().numpy()
        alpha = rendered.alpha.detach().double().cpu().numpy()
        best = np.fmax(best, disc_shares(camera, depth.reshape(alpha.shape[:2]), centers, diameters))
    return best


def disc_shares(camera: Camera, depth: FloatArray, centers: FloatArray, diameters: FloatArray) -> FloatArray:
    """(F,) share of each sphere's disc in one view where `depth` (H, W) does not lie in front of the sphere.

    A pixel is free when its depth is behind the sphere's front less half a radius. NaN for spheres behind the camera or
    less than half in the picture.
    """
    local = centers @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    shares = np.full(len(centers), np.nan)
    for index in np.flatnonzero(local[:, 2] > diameters):
        x, y, z = local[index]
        radius = diameters[index] / 2.0
        u, v = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
        reach_u, reach_v = camera.K[0, 0] * radius / z, camera.K[1, 1] * radius / z
        columns = np.arange(int(np.floor(u - reach_u)), int(np.ceil(u + reach_u)) + 1)
        rows = np.arange(int(np.floor(v - reach_v)), int(np.ceil(v + reach_v)) + 1)
        off = ((columns[None, :] + 0.5 - u) / reach_u) ** 2 + ((rows[:, None] + 0.5 - v) / reach_v) ** 2
        disc = off < 1.0
        framed = (columns >= 0) & (columns < camera.width)
        inside = disc & framed[None, :] & ((rows >= 0) & (rows < camera.height))[:, None]
        if inside.sum() < 0.5 * max(disc.sum(), 1):
            continue
        front = z - radius * np.sqrt(np.maximum(1.0 - off, 0.0))
        row, column = np.nonzero(inside)
        free = depth[rows[row], columns[column]] > front[row, column] - 0.5 * radius
        shares[index] = free.sum() / disc.sum()
    return shares
