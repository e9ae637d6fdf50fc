"""Semantic codes trained into the Gaussians together with colour (paper eq. 7 to 9)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...config import EmbedConfig
from ...errors import SceneError
from ...progress import Progress, part, silent
from ...scene.camera import Camera
from ...scene.photos.spool import spool
from ...splatting.gaussians import Gaussians
from ...splatting.training.extra_channels import ExtraChannels
from ..masks.segments import SegmentedView
from .autoencoder import CODE, Autoencoder, train_autoencoders
from .cells import cell_weights, cells_of, pair_masks
from .features import Features
from .lift_segments import judge_features
from .semantic_kernels import semantic_loss

WEIGHT, LEARNING_RATE = 0.1, 0.02
"""Weight of the semantic loss relative to the photometric one (the paper's λ_sem), and learning rate of the codes."""


@dataclass(frozen=True, eq=False)
class CodedView:
    """The target codes of one photo.

    cells: (H, W) the row of each pixel, as small integers; codes: (C + 1, L · 3) float32, unit for each level, 0 if a
    level has no mask; the last row is for pixels outside all masks.
    """

    cells: NDArray[Any]
    codes: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Semantics:
    """The masks' side of joint training, and the way from codes back to features.

    views: one per camera, in its order; levels: L; autoencoders: one for all levels or one per level; encoder_id: of
    the encoder of the masks' features; key: a hash of all that and of the settings.
    """

    views: Sequence[CodedView]
    levels: int
    autoencoders: tuple[Autoencoder, ...]
    encoder_id: str
    key: str

    def loss(self, weight: float, view: int, drawn: NDArray[np.float32], gradient: NDArray[np.float32]) -> float:
        """weight · L_sem of a rendered view (L · 3, H, W), eq. 8: the sum over levels of the mean over pixels with a
        mask; its gradient is written. A smaller view is compared with every n-th pixel."""
        coded = self.views[view]
        cells = sample_nearest(coded.cells, drawn.shape[1], drawn.shape[2])
        pixels = max(int((cells < len(coded.codes) - 1).sum()), 1)
        l1_sums, cosine_sums = np.empty(len(cells)), np.empty(len(cells))
        semantic_loss(
            drawn, cells.astype(np.int32), coded.codes, self.levels, weight / pixels, gradient, l1_sums, cosine_sums
        )
        return weight * float(l1_sums.sum() + cosine_sums.sum()) / pixels

    def channels(self, config: EmbedConfig) -> ExtraChannels:
        """The extra channels with which `train` trains the codes."""
        return ExtraChannels(
            count=CODE * self.levels,
            loss=lambda view, drawn, gradient: self.loss(WEIGHT, view, drawn, gradient),
            rate=LEARNING_RATE,
            after=config.semantic_after,
            moves_gaussians=config.semantic_moves,
            key=self.key,
        )

    def features(self, channels: Tensor) -> Features:
        """Trained channels (N, L · 3) as features; weights and agreement are 0 until `judge_channels` measures them."""
        codes = channels.reshape(len(channels), self.levels, CODE)
        none = torch.zeros(len(channels), self.levels)
        decoders = tuple(each.decode for each in self.autoencoders)
        return Features(torch.nn.functional.normalize(codes, dim=-1), none, none, self.encoder_id, decoders)


def prepare_joint(
    cameras: Sequence[Camera],
    views: Iterable[SegmentedView],
    config: EmbedConfig,
    *,
    encoder_id: str,
    spool_in: Path | None = None,
    progress: Progress = silent,
) -> Semantics:
    """Learn the codes of the masks and prepare them for training; pass `.channels(config)` to `train` as `extra`.

    views: one per camera of the scene, including held-out ones, which are not trained on; read twice, one at a time.
    spool_in: a folder for files from which the cells of the pixels are mapped; without it they are in memory.

    Raises:
        SceneError: views and cameras do not fit, or no photo has a mask.
        EncoderError: a mask's vector is not finite.
    """
    shapes: set[tuple[int, int]] = set()
    used: list[list[Tensor]] = []
    for _, view in pair_masks(cameras, views):
        shapes.add((len(view.labels), view.vectors.shape[1]))
        used.append([view.vectors[_find_used(labels)] for labels in view.labels])
    if len(shapes) > 1:
        raise SceneError(f"The photos' masks differ in levels or features ({shapes}). Segment all the same way")
    of_level = [torch.cat(vectors) for vectors in zip(*used, strict=True)]
    if not sum(map(len, of_level)):
        raise SceneError("No photo has a mask with a feature. Use other masks, or the embedded encoder")
    levels = len(of_level)
    autoencoders = train_autoencoders(of_level, config, progress=progress)
    coded = []
    for index, (_, view) in enumerate(pair_masks(cameras, views)):
        targets = _encode(view, autoencoders)
        if spool_in is not None:
            targets = replace(targets, cells=spool(targets.cells, spool_in / f"{index:06d}.cells.npy"))
        coded.append(targets)
    digest = hashlib.sha256(json.dumps([asdict(config), encoder_id], sort_keys=True).encode())
    for each in coded:
        digest.update(np.ascontiguousarray(each.cells).tobytes())
        digest.update(each.codes.tobytes())
    return Semantics(coded, levels, autoencoders, encoder_id, digest.hexdigest())


def judge_channels(
    semantics: Semantics,
    channels: Tensor,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    views: Iterable[SegmentedView],
    *,
    progress: Progress = silent,
) -> Features:
    """Return trained channels (N, L · 3) as features, with the pixels of each Gaussian and the agreement of the photos.

    Raises:
        SceneError: views and cameras do not fit.
    """
    table = cell_weights(gaussians, cameras, views, progress=part(progress, 0.0, 0.7))
    features = judge_features(table, semantics.features(channels), progress=part(progress, 0.7, 1.0))
    seen = (features.weights > 0)[..., None]
    return replace(features, vectors=features.vectors * seen)


def sample_nearest(cells: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Sample (H, W) → (height, width) by the pixel under each centre."""
    rows = ((np.arange(height) + 0.5) * cells.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * cells.shape[1] / width).astype(np.int64)
    return cells[rows[:, None], columns]


def _find_used(labels: NDArray[np.int32]) -> Tensor:
    found = np.unique(labels)
    return torch.from_numpy(found[found >= 0].astype(np.int64))


def _encode(view: SegmentedView, autoencoders: tuple[Autoencoder, ...]) -> CodedView:
    cells, table = cells_of(view.labels)
    codes = torch.zeros(table.shape[1] + 1, len(view.labels), CODE)
    for level, rows in enumerate(torch.from_numpy(table.astype(np.int64))):
        autoencoder = autoencoders[level if len(autoencoders) > 1 else 0]
        has = rows >= 0
        codes[:-1, level][has] = autoencoder.encode(view.vectors[rows[has]])
    numbered = np.where(cells < 0, table.shape[1], cells)
    small = numbered.astype(np.uint16 if table.shape[1] < 2**16 else np.int32)
    return CodedView(small, codes.reshape(len(codes), -1).numpy())
