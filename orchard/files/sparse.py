"""A COLMAP model of the views, with a sparse cloud similar to that of structure from motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..cameras.viewpoint import Viewpoint

FloatArray = NDArray[np.float64]

LONGEST_TRACK = 5
"""Average number of views that observe a point: matching never finds a point in every view."""


@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Points with colours and the views that show them."""

    points: FloatArray
    """(P, 3) metres."""
    colors: NDArray[np.uint8]
    """(P, 3)"""
    tracks: tuple[tuple[int, ...], ...]
    """For each point the numbers of the views that show it, at least two."""


def sample_cloud(
    rng: np.random.Generator,
    views: Sequence[Viewpoint],
    depths: Sequence[NDArray[np.float32]],
    pictures: Sequence[NDArray[np.uint8]],
    count: int,
) -> Cloud:
    """Points on visible surfaces: random pixels, unprojected by depth, moved by a few millimetres.

    The other observations of a point are views whose depth at its pixel agrees within 1 %. Points in a single view are
    dropped, as in structure from motion. The noise grows with the depth: 0.1 % of it.
    """
    each = int(np.ceil(1.6 * count / len(views)))
    found: list[tuple[FloatArray, NDArray[np.uint8], tuple[int, ...]]] = []
    for number, (view, depth, picture) in enumerate(zip(views, depths, pictures, strict=True)):
        middle = np.median(depth[depth > 0]) if (depth > 0).any() else 0.0
        rows, columns = np.nonzero((depth > 0) & (depth < 6 * middle))
        chosen = rng.permutation(len(rows))[:each]
        rows, columns = rows[chosen], columns[chosen]
        pixels = np.stack([columns, rows], axis=1) + 0.5
        z = depth[rows, columns].astype(np.float64)
        points = view.unproject(pixels, z)
        seen = _find_seen(points, views, depths)
        seen &= rng.uniform(size=seen.shape) < LONGEST_TRACK / np.maximum(seen.sum(axis=1, keepdims=True), 1)
        seen[:, number] = True
        noisy = points + rng.normal(size=points.shape) * (0.001 * z)[:, None]
        for point, color, who in zip(noisy, picture[rows, columns], seen, strict=True):
            if who.sum() >= 2:
                found.append((point, color, tuple(int(i) for i in np.flatnonzero(who))))
    order = rng.permutation(len(found))[:count]
    return Cloud(
        points=np.array([found[i][0] for i in order]).reshape(-1, 3),
        colors=np.array([found[i][1] for i in order], dtype=np.uint8).reshape(-1, 3),
        tracks=tuple(found[i][2] for i in order),
    )


def _find_seen(
    points: FloatArray, views: Sequence[Viewpoint], depths: Sequence[NDArray[np.float32]]
) -> NDArray[np.bool_]:
    """Find (M, V) whether a view's depth at the point's pixel agrees with the point's."""
    seen = np.zeros((len(points), len(views)), dtype=bool)
    for i, (view, depth) in enumerate(zip(views, depths, strict=True)):
        pixels, z = view.project(points)
        column, row = np.floor(pixels).astype(np.int64).T
        fits = (z > 0) & (column >= 0) & (row >= 0) & (column < view.width) & (row < view.height)
        there = depth[np.clip(row, 0, view.height - 1), np.clip(column, 0, view.width - 1)]
        seen[:, i] = fits & (np.abs(there - z) < 0.01 * np.maximum(z, 1e-6))
    return seen


def write_model(folder: Path, views: Sequence[Viewpoint], cloud: Cloud, written: Sequence[Viewpoint]) -> None:
    """Write cameras.bin, images.bin and points3D.bin (one shared PINHOLE camera).

    `views` took the pictures and define the observations; `written` are the poses to write.
    """
    import pycolmap

    first = views[0]
    model = pycolmap.Reconstruction()
    params = [first.focal, first.focal, first.width / 2, first.height / 2]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=first.width, height=first.height, params=params)
    )
    observations: list[list[FloatArray]] = [[] for _ in views]
    tracks = []
    for point, who in zip(cloud.points, cloud.tracks, strict=True):
        track = pycolmap.Track()
        for i in who:
            track.add_element(i + 1, len(observations[i]))
            observations[i].append(views[i].project(point[None])[0][0])
        tracks.append(track)
    for i, view in enumerate(views):
        image = pycolmap.Image(
            name=view.name, camera_id=1, image_id=i + 1, keypoints=np.array(observations[i]).reshape(-1, 2)
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(written[i].world_to_camera))
    for point, color, track in zip(cloud.points, cloud.colors, tracks, strict=True):
        model.add_point3D(point, track, color)
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))
