"""How much of every label of a picture each Gaussian rendered, as a sparse table: most cover one or two labels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compiled.jit import threads
from ...errors import SceneError
from ...scene.camera import Camera
from ..gaussians import Gaussians
from ..gpu.views import CardViews
from ..kernels.labels import count_labels, gather_labels, sum_labels
from .device import try_on_card
from .rasterize import check_camera
from .render import DrawRules, arrays_of, project_view, tile_view
from .workspace import Workspace

LABELS_AT_ONCE = 64
"""Labels that a graphics card sums in one pass over the pixels."""


@dataclass(frozen=True, eq=False)
class LabelWeights:
    """A sparse (Gaussian, label) table by rows, as in scipy's CSR format; labels of a row are not sorted.

    starts: (N + 1,) where each Gaussian's entries begin; labels: (K,) int32; weights: (K,) float32 Σ α_i T_i over the
    pixels of that label, above 0.
    """

    starts: NDArray[np.int64]
    labels: NDArray[np.int32]
    weights: NDArray[np.float32]


def label_weights(
    gaussians: Gaussians, camera: Camera, labels: NDArray[np.int32], *, workspace: Workspace | None = None
) -> LabelWeights:
    """Sum a view's blending weights into (Gaussian, label) pairs: W_im = Σ_{v in m} α_i(v) T_i(v).

    labels: (H, W) int32 at the camera's size, from 0 on without large gaps, negative for none. The bytes do not depend
    on the number of threads. workspace: memory that is reused from view to view.

    Raises:
        SceneError: the labels' size differs from the camera's, or the camera has distortion.
    """
    check_camera(camera)
    if labels.shape != (camera.height, camera.width):
        raise SceneError(
            f"The labels are {labels.shape}. Their sizes must be the camera's ({camera.height}, {camera.width})"
        )
    workspace = workspace or Workspace()
    rules = DrawRules(sh_degree=0, antialiased=gaussians.antialiased)
    summed = try_on_card(lambda views: _sum_on_card(views, gaussians, camera, rules, labels))
    if summed is not None:
        return summed
    tiles = tile_view(project_view(arrays_of(gaussians), camera, rules, workspace), camera, rules, workspace)
    labels = np.ascontiguousarray(labels, np.int32)
    in_tile = np.empty(len(tiles.tile_starts) - 1, np.int64)
    count_labels(tiles.columns, labels, in_tile)
    room = np.concatenate([[0], np.cumsum(in_tile * np.diff(tiles.tile_starts))])
    pair_starts = workspace.take("pair_starts", (tiles.pairs,), np.int64)
    pair_counts = workspace.take("pair_counts", (tiles.pairs,), np.int32)
    pair_labels = workspace.take("pair_labels", (int(room[-1]),), np.int32)
    pair_sums = workspace.take("pair_sums", (int(room[-1]),))
    sum_labels(
        threads(), tiles.columns, tiles.order, tiles.records.reshape(-1), tiles.tile_starts, tiles.gaussian_of,
        tiles.pair_of, labels, room, pair_starts, pair_counts, pair_labels, pair_sums,
    )  # fmt: skip
    listed = (tiles.starts, tiles.counts, pair_starts, pair_counts, pair_labels, pair_sums)
    highest = max(int(labels.max(initial=-1)) + 1, 1)
    starts = np.zeros(len(gaussians) + 1, np.int64)
    found, sums = np.empty(0, np.int32), np.empty(0, np.float32)
    gather_labels(threads(), highest, *listed, starts, found, sums)
    np.cumsum(starts, out=starts)
    if starts[-1] > 0:
        found, sums = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
        gather_labels(threads(), highest, *listed, starts, found, sums)
    return LabelWeights(starts, found, sums)


def _sum_on_card(
    views: CardViews, gaussians: Gaussians, camera: Camera, rules: DrawRules, labels: NDArray[np.int32]
) -> LabelWeights:
    """Do the same on a graphics card: a channel for each label."""
    rows, columns, weights = [], [], []
    for first in range(0, int(labels.max(initial=-1)) + 1, LABELS_AT_ONCE):
        wanted = np.arange(first, min(first + LABELS_AT_ONCE, int(labels.max()) + 1), dtype=np.int32)
        target = (labels[..., None] == wanted).astype(np.float32)
        sums, _ = views.accumulate(gaussians, camera, rules, target)
        row, column = np.nonzero(sums > 0.0)
        rows.append(row)
        columns.append(wanted[column])
        weights.append(sums[row, column])
    row = np.concatenate([np.zeros(0, np.int64), *rows])
    order = np.argsort(row, kind="stable")
    starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=len(gaussians)))])
    listed = np.concatenate([np.zeros(0, np.int32), *columns])[order]
    return LabelWeights(starts, listed, np.concatenate([np.zeros(0, np.float32), *weights])[order])
