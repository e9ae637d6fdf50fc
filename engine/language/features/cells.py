"""The masks that every Gaussian covers, over all views and levels: one sparse table that is computed once.

A cell is a set of pixels of a view that lie in the same masks at every level, so that one pass over the tiles of a view
serves all levels.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ...compiled.jit import threads
from ...errors import EncoderError, SceneError
from ...progress import Progress, silent
from ...scene.camera import Camera
from ...splatting.gaussians import Gaussians
from ...splatting.rendering.label_weights import LabelWeights, label_weights
from ...splatting.rendering.workspace import Workspace
from ..masks.segments import SegmentedView
from .mixing_kernels import append_view
from .pairing import pair_views

LEAST_LENGTH = 1e-6
"""A mask whose vector is shorter than this has no feature."""


@dataclass(frozen=True, eq=False)
class CellWeights:
    """How much of every cell each Gaussian covers, and the features of the cells' masks.

    starts: (N + 1,), cells: (K,) int32, weights: (K,) float32 Σ α·T, a sparse table by Gaussian whose rows go from view
    to view; view_of: (C,) int32 and row_of: (L, C) int32 the view of each cell and the row in `vectors` of its mask at
    each level, -1 for none; vectors: (M, D) unit float32 of all views' masks; most: largest number of views that show
    one Gaussian.
    """

    starts: NDArray[np.int64]
    cells: NDArray[np.int32]
    weights: NDArray[np.float32]
    view_of: NDArray[np.int32]
    row_of: NDArray[np.int32]
    vectors: Tensor
    most: int

    @property
    def levels(self) -> int:
        return len(self.row_of)

    def pad_vectors(self, length: int) -> NDArray[np.float32]:
        """Return (M · length,) the vectors row by row, padded with zeros, as kernels read them."""
        behind = length - self.vectors.shape[1]
        vectors = functional.pad(self.vectors, (0, behind)) if behind else self.vectors
        return vectors.contiguous().numpy().reshape(-1)


def cell_weights(
    gaussians: Gaussians, cameras: Sequence[Camera], views: Iterable[SegmentedView], *, progress: Progress = silent
) -> CellWeights:
    """Sum every view's blending weights into (Gaussian, cell) pairs.

    Raises:
        SceneError: views and cameras do not fit, or no photo has a mask.
        EncoderError: a mask's vector is not finite.
    """
    drawn: list[LabelWeights] = []
    view_of: list[NDArray[np.int32]] = []
    row_of: list[NDArray[np.int32]] = []
    vectors: list[Tensor] = []
    rows = 0
    workspace = Workspace()
    for index, (camera, view) in enumerate(pair_masks(cameras, views)):
        progress(index / len(cameras), f"Lifting masks of view {index + 1} of {len(cameras)}")
        if index and (len(view.labels), view.vectors.shape[1]) != (len(row_of[0]), vectors[0].shape[1]):
            raise SceneError(
                f"View {index} has {len(view.labels)} levels of {view.vectors.shape[1]} numbers, those before "
                f"{len(row_of[0])} of {vectors[0].shape[1]}. Segment all photos the same way"
            )
        cells, table = cells_of(view.labels)
        drawn.append(label_weights(gaussians, camera, cells, workspace=workspace))
        view_of.append(np.full(table.shape[1], index, np.int32))
        row_of.append(np.where(table >= 0, table + rows, -1).astype(np.int32))
        vectors.append(view.vectors)
        rows += len(view.vectors)
    if rows == 0:
        raise SceneError("No photo has a mask with a feature. Use other masks, or the embedded encoder")
    joined = _join_views(drawn, [len(numbers) for numbers in view_of], len(gaussians))
    return CellWeights(
        joined.starts,
        joined.labels,
        joined.weights,
        np.concatenate(view_of),
        np.concatenate(row_of, axis=1),
        torch.cat(vectors),
        len(cameras),
    )


def pair_masks(cameras: Sequence[Camera], views: Iterable[SegmentedView]) -> Iterator[tuple[Camera, SegmentedView]]:
    """Yield each camera with its masks that have a feature (see `usable`).

    Raises:
        SceneError: views and cameras do not fit, or a label has no vector.
        EncoderError: a vector is not finite.
    """
    for index, camera, view in pair_views(cameras, views, lambda view: view.labels.shape[1:], "masks"):
        yield camera, keep_usable(view, index)


def keep_usable(view: SegmentedView, index: int) -> SegmentedView:
    """Return the view with unit vectors and without masks that have no feature (a vector of length 0).

    Raises:
        SceneError: a label has no vector.
        EncoderError: a vector is not finite.
    """
    vectors = view.vectors.detach().float()
    highest = int(view.labels.max(initial=-1))
    if highest >= len(vectors):
        raise SceneError(f"View {index} has mask {highest} but {len(vectors)} features. Give each mask one")
    broken = (~torch.isfinite(vectors).all(1)).nonzero()
    if len(broken):
        raise EncoderError(
            f"The feature of mask {int(broken[0])} of view {index} is not a number ({len(broken)} of "
            f"{len(vectors)} are not). Encode in full precision, or check the encoder's weights"
        )
    empty = vectors.norm(dim=1) < LEAST_LENGTH
    labels = np.asarray(view.labels, np.int32)
    if bool(empty.any()):
        kept = np.append(np.where(empty.numpy(), -1, np.arange(len(vectors))), -1).astype(np.int32)
        labels = kept[labels]  # -1 selects the last
    return SegmentedView(labels, functional.normalize(vectors, dim=1))


def cells_of(labels: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """(L, H, W) labels → (H, W) cell numbers, -1 outside all masks, and (L, C) the labels of each cell."""
    keys = np.zeros(labels.shape[1:], np.int64)
    base = int(labels.max(initial=-1)) + 2
    for level in labels:
        found, numbers = np.unique(keys * base + (level + 1), return_inverse=True)
        keys = numbers.reshape(keys.shape)  # numbered again, so that many levels do not overflow
    places = np.empty(len(found), np.int64)
    flat = keys.reshape(-1)
    places[flat] = np.arange(flat.size)
    table = labels.reshape(len(labels), -1)[:, places]
    outside = (table < 0).all(0)
    numbers = np.where(outside, -1, np.cumsum(~outside) - 1).astype(np.int32)
    return numbers[keys], np.ascontiguousarray(table[:, ~outside])


def _join_views(drawn: list[LabelWeights], cells: Sequence[int], n: int) -> LabelWeights:
    """Join the tables of the views; each is freed on the way, to save memory."""
    starts = np.zeros(n + 1, np.int64)
    for view in drawn:
        starts[1:] += np.diff(view.starts)
    np.cumsum(starts, out=starts)
    labels, weights = np.empty(starts[-1], np.int32), np.empty(starts[-1], np.float32)
    places, offset = starts[:-1].copy(), 0
    for index, view in enumerate(drawn):
        append_view(threads(), view.starts, view.labels, view.weights, offset, places, labels, weights)
        drawn[index] = LabelWeights(view.starts[:1], view.labels[:0], view.weights[:0])
        offset += cells[index]
    return LabelWeights(starts, labels, weights)
