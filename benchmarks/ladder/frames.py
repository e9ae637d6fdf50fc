"""Maps the frame of estimated poses to that of the truth: by true positions of Gaussians on fruit, or by the
cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ...engine.evaluation.camera_errors import camera_similarity
from ...engine.scene.alignment import Similarity, align
from ...engine.scene.camera import Camera, Photo, Scene
from ...engine.scene.photos.lens import source_map
from ...engine.scene.photos.photo import FilePhoto
from ...engine.splatting.gaussians import Gaussians
from ...engine.splatting.rendering.rasterize import accumulate

FloatArray = NDArray[np.float64]

_OF_FRUIT = 0.5
"""Share of a Gaussian's pixels that must be fruit for its true position to be on fruit."""
_STRONG = 0.5
"""Share of those Gaussians that are used: those with most pixels. Weak ones correct single views and lie anywhere."""
_FIRM = 0.25
"""Share of the strong ones that are used: those whose pixels agree best on the true position."""
_LEAST_PAIRS = 30


def align_by_cameras(found: Scene, true: Scene) -> Similarity:
    """Find the similarity from the frame of `found` to that of `true`, by the centres of common cameras.

    Raises:
        SceneError: fewer than 3 are common, or they stand on one line.
    """
    return camera_similarity(cameras_by_file(found), cameras_by_file(true))


def align_by_fruit(
    gaussians: Gaussians,
    found: Scene,
    true: Scene,
    depths: Sequence[NDArray[np.float32]],
    instances: Sequence[NDArray[np.uint16]],
) -> Similarity:
    """Find the similarity from the frame of `found` to that of `true`, by the true positions of the pixels that show
    fruit.

    Estimated cameras are off by centimetres, and so is a frame aligned by their centres; this aligns the surfaces that
    are counted. Each Gaussian of `found` covers pixels of the photos; depths (H, W) and instances (H, W) of the views
    of `true` give the position of each pixel on a fruit. The true position of a Gaussian whose pixels agree is their
    mean, weighted by coverage. With fewer than 30 such Gaussians `align_by_cameras` is used.

    Raises:
        SceneError: as `align_by_cameras`.
    """
    middle = true.middle  # float32 sums of squares want small numbers
    shown = {
        Path(photo.name).name: _places(camera, depth, ids > 0, middle)
        for photo, camera, depth, ids in zip(true.images, true.cameras, depths, instances, strict=True)
    }
    sums, weights = torch.zeros(len(gaussians), 5), torch.zeros(len(gaussians))
    for photo, camera in zip(found.images, found.cameras, strict=True):
        places = shown.get(Path(photo.name).name)
        if places is not None:
            drawn = accumulate(gaussians, camera, torch.from_numpy(warp_to_view(photo, places)))
            sums += drawn.sums
            weights += drawn.weights
    totals, of_fruit = sums.double().numpy(), sums[:, 3].numpy()
    chosen = np.flatnonzero((of_fruit > 0.0) & (of_fruit >= _OF_FRUIT * weights.numpy()))
    chosen = chosen[np.argsort(of_fruit[chosen], kind="stable")][len(chosen) - int(_STRONG * len(chosen)) :]
    target = totals[chosen, :3] / totals[chosen, 3:4]
    spread = totals[chosen, 4] / totals[chosen, 3] - (target**2).sum(axis=1)
    firm = np.argsort(spread, kind="stable")[: int(_FIRM * len(chosen))]
    if len(firm) < _LEAST_PAIRS:
        return align_by_cameras(found, true)
    return align(gaussians.means.double().numpy()[chosen[firm]], target[firm] + middle)


def warp_to_view(photo: Photo, values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values (H, W, C) of the undistorted photo's pixels, from the nearest pixel of the original; 0
    outside."""
    if not isinstance(photo, FilePhoto) or photo.lens.is_pinhole:
        return values
    source = source_map(photo.lens, photo.face, photo.width, photo.height)
    height, width = values.shape[:2]
    columns = np.clip(source.pixels[..., 0].astype(np.int64), 0, width - 1)
    rows = np.clip(source.pixels[..., 1].astype(np.int64), 0, height - 1)
    return np.where(source.valid[..., None], values[rows, columns], np.float32(0.0))


def cameras_by_file(scene: Scene) -> dict[str, Camera]:
    """The cameras by the names of their photos' files, without folders."""
    return {Path(photo.name).name: camera for photo, camera in zip(scene.images, scene.cameras, strict=True)}


def _places(
    camera: Camera, depth: NDArray[np.float32], chosen: NDArray[np.bool_], middle: FloatArray
) -> NDArray[np.float32]:
    """(H, W, 5) x, y, z from `middle`, 1 and x² + y² + z² of the chosen pixels with content; zeros elsewhere."""
    points = camera.unproject(depth.astype(np.float64)) - middle
    squares = (points**2).sum(axis=-1, keepdims=True)
    places = np.concatenate([points, np.ones_like(squares), squares], axis=-1)
    return np.where((chosen & (depth > 0))[..., None], places, 0.0).astype(np.float32)
