"""What the views show: of each Gaussian by its blending weights, of each fruit by the depths of rendered views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from numpy.typing import NDArray

from ...progress import Progress, silent
from ...scene.camera import Camera
from ...splatting.gaussians import Gaussians
from ...splatting.kernels.surface import NOTHING
from ...splatting.rendering.rasterize import accumulate, draw_surface
from .visibility_kernels import measure_discs

FloatArray = NDArray[np.float64]

SEEN_WEIGHT = 0.3
"""Summed blending weight, in pixels of the camera's own size, from which a Gaussian counts as visible in a view."""
MOST_PIXELS = 40_000_000
"""Pixels of all views together; larger views are rendered smaller."""
LEAST_VIEW = 240 * 180
"""Pixels below which no view is rendered smaller, however many there are. A row of 200 photos had 326 fruit at this
size, and 328 at 2.2 times as many pixels."""
SPOTS = 48
"""Pixels tested on the disc of each sphere in each view."""
RIM = 0.8
"""Only the disc within this many radii shows what lies behind a sphere: a fit is slightly off at its rim."""
TOLERANCE = 0.5
"""Radii in front of the surface of a sphere from which an object is an occluder."""
LEAST_SHARE = 0.1
"""Share of the disc without occluders from which a view shows a fruit."""
STOP = 0.3
"""A ray is stopped by a sphere if it ends before this share of the way from the centre to the back."""
SHOWN = 0.25
"""Blended probability, in thresholds, of a spot that shows a fruit; below it an object covers the fruit."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A view rendered from the Gaussians. depth: (H, W) of the surface, as in `SurfaceView`; fruit: (H, W) blended
    probability Σ α T p."""

    camera: Camera
    depth: NDArray[np.float32]
    fruit: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Visibility:
    """How N Gaussians appear in the views.

    weights: (N,) pixels of the cameras' own size drawn by each Gaussian, summed over views; views: (N,) views that show
    it; directions: (N, 3)
    weighted mean of the unit directions towards the cameras that show it, zero if none does. Its length says how
    similar these directions are. frame: (3, 4) of the cameras, see `frame_of`.
    """

    weights: FloatArray
    views: NDArray[np.int64]
    directions: FloatArray
    frame: FloatArray = field(default_factory=lambda: np.eye(3, 4))


@dataclass(frozen=True, eq=False)
class ViewEvidence:
    """How C spheres appear in the views.

    visible_fractions: largest over views of the share of the disc without occluders, NaN if no view frames half of it;
    free: spots of the disc without occluders, over all views; solidity: the share of these that does not show what is
    behind the sphere; probabilities: mean blended probability on those that show the sphere, both 1 if no view has a
    free spot; views: how many show at least LEAST_SHARE of the disc.
    """

    visible_fractions: FloatArray
    free: FloatArray
    solidity: FloatArray
    probabilities: FloatArray
    views: NDArray[np.int64]

    def select(self, index: NDArray) -> ViewEvidence:
        """The evidence of the spheres at `index`."""
        return ViewEvidence(**{each.name: getattr(self, each.name)[index] for each in fields(self)})


def find_visibility(gaussians: Gaussians, cameras: Sequence[Camera], *, progress: Progress = silent) -> Visibility:
    """Sum the blending weights α·T of every view into the Gaussians that rendered its pixels."""
    means = gaussians.means.detach().double().cpu().numpy()
    weights, views = np.zeros(len(means)), np.zeros(len(means), np.int64)
    directions = np.zeros((len(means), 3))
    for index, (own, camera) in enumerate(zip(cameras, scale_to_drawing_size(cameras), strict=True)):
        progress(index / len(cameras), f"Rendering view {index + 1} of {len(cameras)}")
        nothing = torch.zeros(camera.height, camera.width, 0)
        drawn = accumulate(gaussians, camera, nothing).weights.double().numpy()
        drawn *= own.width * own.height / (camera.width * camera.height)
        shown = np.flatnonzero(drawn)  # of a row each view shows only a few
        towards = camera.center - means[shown]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        weights[shown] += drawn[shown]
        views[shown] += drawn[shown] > SEEN_WEIGHT
        directions[shown] += drawn[shown, None] * towards
    return Visibility(weights, views, directions / np.maximum(weights, 1e-12)[:, None], frame_of(cameras))


def frame_of(cameras: Sequence[Camera]) -> FloatArray:
    """(3, 4) from the world to the frame of the first camera, in units of `distance_of`: a position keeps its
    coordinates if scene and cameras are moved together."""
    frame: FloatArray = cameras[0].world_to_camera[:3] / distance_of(cameras)
    return frame


def distance_of(cameras: Sequence[Camera]) -> float:
    """Root mean square distance of the cameras from their middle, scene units; 1 if they are at the same position."""
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    if len(centers) < 2:
        return 1.0
    return float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean())) or 1.0


def draw(
    gaussians: Gaussians, probability: FloatArray, cameras: Sequence[Camera], *, progress: Progress = silent
) -> list[Picture]:
    """Depth and blended probability (N,) in every view."""
    probabilities = torch.from_numpy(probability).float()[:, None]
    pictures = []
    for index, camera in enumerate(scale_to_drawing_size(cameras)):
        progress(index / len(cameras), f"Rendering view {index + 1} of {len(cameras)}")
        drawn = draw_surface(gaussians, camera, probabilities)
        pictures.append(Picture(camera, drawn.depth, np.ascontiguousarray(drawn.features[:, :, 0])))
    return pictures


def gather_view_evidence(
    pictures: Sequence[Picture], centers: FloatArray, radii: FloatArray, threshold: float
) -> ViewEvidence:
    """Test the discs of C spheres, centers (C, 3) and radii (C,) in scene units, in every picture."""
    best, sums = _measure_discs(pictures, centers, radii, tolerance=TOLERANCE, stop=STOP, shown=SHOWN * threshold)
    stopped, free, probable, views = sums.T
    unknown = free == 0
    return ViewEvidence(
        visible_fractions=np.where(best < 0.0, np.nan, best),
        free=free,
        solidity=np.where(unknown, 1.0, stopped / np.maximum(free, 1.0)),
        probabilities=np.where(unknown, 1.0, probable / np.maximum(stopped, 1.0)),
        views=views.astype(np.int64),
    )


def count_open_views(pictures: Sequence[Picture], centers: FloatArray, radii: FloatArray) -> NDArray[np.int64]:
    """Count the views (C,) in which at least LEAST_SHARE of the disc of each of C spheres, which need not exist, has no
    occluder: how many would show a fruit at that position."""
    _, sums = _measure_discs(pictures, centers, radii, tolerance=0.0, stop=float(NOTHING), shown=-1.0)
    return sums[:, 3].astype(np.int64)


def _measure_discs(
    pictures: Sequence[Picture],
    centers: FloatArray,
    radii: FloatArray,
    *,
    tolerance: float,
    stop: float,
    shown: float,
) -> tuple[FloatArray, FloatArray]:
    """Largest visible share (C,), -1 for none, and sums (C, 4) over all pictures; see
    `visibility_kernels.measure_discs`."""
    disc = spiral(SPOTS)
    centers, radii = np.ascontiguousarray(centers), np.ascontiguousarray(radii)
    best, sums = np.full(len(centers), -1.0), np.zeros((len(centers), 4))
    for picture in pictures:
        camera = picture.camera
        measure_discs(
            picture.depth, picture.fruit, camera.world_to_camera, camera.K, centers, radii, disc,
            RIM, tolerance, stop, shown, LEAST_SHARE, best, sums,
        )  # fmt: skip
    return best, sums


def spiral(count: int) -> FloatArray:
    """(count, 2) spots spread evenly over the unit disc (Vogel's spiral)."""
    index = np.arange(count) + 0.5
    radius, turn = np.sqrt(index / count), np.pi * (3.0 - 5.0**0.5) * index
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=1)


def scale_to_drawing_size(cameras: Sequence[Camera]) -> list[Camera]:
    """Scale all cameras down by one factor if their pixels together are too many to keep, but none below LEAST_VIEW
    pixels."""
    pixels = [camera.width * camera.height for camera in cameras]
    share = MOST_PIXELS / max(sum(pixels), 1)
    factors = [min(1.0, max(share, LEAST_VIEW / own) ** 0.5) for own in pixels]
    return [camera.scale(factor) for camera, factor in zip(cameras, factors, strict=True)]
