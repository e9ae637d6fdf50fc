"""The true geometry of a generated scene as Gaussians: a reconstruction without loss."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..errors import SceneError
from ..progress import Progress, silent
from ..scene.camera import Camera, Scene
from ..splatting.gaussians import Gaussians, harmonics_of, logit

FloatArray = NDArray[np.float64]

MOST_PIXELS = 8_000_000
"""Most pixels of all views together; of more, an even sample."""
MOST_GAUSSIANS = 250_000
FAR = 6.0
"""Points farther than this many median depths are left out."""
WIDTH, THICKNESS = 0.4, 0.08
"""Standard deviations along the surface and across it, in cells."""
SET_BACK = 0.5
"""Depth of the Gaussians below the surface, in cells: their renders are about a pixel wider than they are."""
OPACITY = 0.99

OPPOSED = 1e-3
"""A cell whose mean normal is shorter than this was seen equally from both sides."""


@dataclass(frozen=True, eq=False)
class TrueSurface:
    """gaussians: flat, one per cell of visible surface; fruit: (N,) id of the true fruit of each, 0 for none."""

    gaussians: Gaussians
    fruit: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Seen:
    """P pixels with content: points, normals towards the camera, sRGB in [0, 1], fruit ids, widths of a pixel."""

    points: FloatArray
    normals: FloatArray
    colors: FloatArray
    fruit: NDArray[np.int64]
    widths: FloatArray


def true_surface(
    scene: Scene,
    depths: Sequence[NDArray[np.float32]],
    instances: Sequence[NDArray[np.uint16]],
    *,
    progress: Progress = silent,
) -> TrueSurface:
    """Gaussians on the visible surfaces, from true depths (H, W) and fruit ids (H, W) of each view.

    Pixels are sorted into cells about as wide as a pixel on the fruit; each cell of each fruit becomes one flat, opaque
    Gaussian with the mean position, normal and colour of its pixels. Cells grow until there are at most MOST_GAUSSIANS.

    Raises:
        SceneError: no view sees anything.
    """
    pixels = sum(depth.size for depth in depths)
    step = math.ceil(max(1.0, pixels / MOST_PIXELS))
    parts = []
    for view, (camera, photo, depth, ids) in enumerate(
        zip(scene.cameras, scene.images, depths, instances, strict=True)
    ):
        progress(view / len(scene.cameras), f"true surface of view {view + 1} of {len(scene.cameras)}")
        parts.append(_read_view(camera, photo.pixels(), depth, ids, step, first=view % step))
    seen = _Seen(*(np.concatenate([getattr(part, name) for part in parts]) for name in _Seen.__dataclass_fields__))
    if len(seen.points) == 0:
        raise SceneError("The depths of all views are empty. Make the scene again")
    on_fruit = seen.fruit > 0
    width = float(np.median(seen.widths[on_fruit] if on_fruit.any() else seen.widths))
    groups = _cells(seen, width)
    while groups.max() >= MOST_GAUSSIANS:
        width *= 1.25
        groups = _cells(seen, width)
    progress(1.0, "true surface")
    return _merge(seen, groups, width)


def _read_view(
    camera: Camera,
    photo: NDArray[np.uint8],
    depth: NDArray[np.float32],
    ids: NDArray[np.uint16],
    step: int,
    first: int,
) -> _Seen:
    z = depth.astype(np.float64)
    something = z > 0
    limit = FAR * float(np.median(z[something])) if something.any() else 0.0
    points = camera.unproject(z)
    normals = np.cross(_slope(points, z, axis=1), _slope(points, z, axis=0))
    lengths = np.linalg.norm(normals, axis=-1, keepdims=True)
    towards = camera.center - points
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-12)  # none if there is only sky
    normals = np.where(lengths > 1e-12, normals / np.maximum(lengths, 1e-12), towards)
    normals *= np.where((normals * towards).sum(-1, keepdims=True) < 0, -1.0, 1.0)
    chosen = np.flatnonzero((something & (z < limit)).ravel())[first::step]
    return _Seen(
        points=points.reshape(-1, 3)[chosen],
        normals=normals.reshape(-1, 3)[chosen],
        colors=photo.reshape(-1, 3)[chosen] / 255.0,
        fruit=ids.ravel()[chosen].astype(np.int64),
        widths=z.ravel()[chosen] / np.sqrt(camera.K[0, 0] * camera.K[1, 1]),
    )


def _slope(points: FloatArray, z: FloatArray, axis: int) -> FloatArray:
    """(H, W, 3) difference to the neighbour along an image axis, the one of two with the nearer depth."""
    ahead, behind = np.roll(points, -1, axis), np.roll(points, 1, axis)
    nearer_ahead = np.abs(np.roll(z, -1, axis) - z) <= np.abs(np.roll(z, 1, axis) - z)
    return np.where(nearer_ahead[..., None], ahead - points, points - behind)


def _cells(seen: _Seen, width: float) -> NDArray[np.int64]:
    """(P,) number of the cell of each pixel: cubes of `width`, separate for each fruit."""
    places = np.floor((seen.points - seen.points.min(axis=0)) / width).astype(np.int64)
    sizes = places.max(axis=0) + 1
    key = ((seen.fruit * sizes[0] + places[:, 0]) * sizes[1] + places[:, 1]) * sizes[2] + places[:, 2]
    return np.unique(key, return_inverse=True)[1].reshape(-1).astype(np.int64)


def _merge(seen: _Seen, groups: NDArray[np.int64], width: float) -> TrueSurface:
    counts = np.bincount(groups).astype(np.float64)

    def mean(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(groups, values[:, k]) / counts for k in range(3)], axis=1)

    normals = mean(seen.normals)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    one_side = seen.normals[
        np.unique(groups, return_index=True)[1]
    ]  # of a leaf as thin as a cell, visible from both sides
    normals = np.where(lengths > OPPOSED, normals / np.maximum(lengths, OPPOSED), one_side)
    n = len(counts)
    scales = np.tile([WIDTH * width, WIDTH * width, THICKNESS * width], (n, 1))
    fruit = np.zeros(n, np.int64)
    fruit[groups] = seen.fruit
    gaussians = Gaussians(
        means=torch.from_numpy(mean(seen.points) - SET_BACK * width * normals).float(),
        log_scales=torch.from_numpy(np.log(scales)).float(),
        quats=torch.from_numpy(_flat_along(normals)).float(),
        opacity_logits=torch.full((n,), logit(OPACITY)),
        sh=harmonics_of(mean(seen.colors)),
        antialiased=True,  # otherwise each is rendered at least a pixel wide and opaque, and all outlines swell
    )
    return TrueSurface(gaussians, fruit)


def _flat_along(normals: FloatArray) -> FloatArray:
    """(N, 4) quaternions w, x, y, z that turn the third axis into the normals (N, 3)."""
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(helper, normals)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
    turned = Rotation.from_matrix(np.stack([x, np.cross(normals, x), normals], axis=2)).as_quat()
    return turned[:, [3, 0, 1, 2]]
