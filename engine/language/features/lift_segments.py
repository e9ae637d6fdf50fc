"""Features of masks, lifted into Gaussians without training."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from ...compiled.jit import threads
from ...compiled.lanes import LANES
from ...progress import Progress, silent
from ...scene.camera import Camera
from ...splatting.gaussians import Gaussians
from ..masks.segments import SegmentedView
from .cells import CellWeights, cell_weights
from .features import Features, blocks
from .mixing_kernels import mix

AT_ONCE = 1 << 24
"""Numbers of features in single precision at a time."""


def lift_segments(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    views: Iterable[SegmentedView],
    *,
    encoder_id: str,
    rounds: int = 0,
    progress: Progress = silent,
) -> Features:
    """Average the features of masks into the Gaussians that cover them: f_i ∝ Σ_m W_im v_m, level by level.

    Equals `lift_features` with images that are constant in each mask: W_im = Σ_{v in m} α_i(v)·T_i(v) is summed once
    for all levels and channels. A pixel outside all masks, or in one whose vector is 0, does not count. With `rounds`,
    views that disagree with the others count less: each round weighs a view by 1 / its distance from the current mean
    (Weiszfeld's steps towards the spherical median, which tolerates nearly half of the views being wrong).

    Views are requested one at a time and report their own progress; `progress` covers what follows the last one.

    Raises:
        SceneError: views and cameras do not fit, or no photo has a mask.
        EncoderError: a mask's vector is not finite.
    """
    table = cell_weights(gaussians, cameras, views)
    return mix_features(table, len(gaussians), encoder_id=encoder_id, rounds=rounds, progress=progress)


def mix_features(
    table: CellWeights, n: int, *, encoder_id: str, rounds: int = 0, progress: Progress = silent
) -> Features:
    """Multiply the table by the vectors of the masks, one block of Gaussians at a time; the result is in half
    precision."""
    levels, length = table.levels, table.vectors.shape[1]
    vectors = torch.empty(n, levels, length, dtype=torch.float16)
    weights, agreement = torch.empty(n, levels), torch.empty(n, levels)
    for level in range(levels):
        for rows in blocks(n, _at_once(length)):
            progress((level + rows.start / max(n, 1)) / levels, f"mixing features of level {level + 1} of {levels}")
            mixed = _Mixed(table, rows, level, rounds)
            vectors[rows, level] = mixed.vectors.half()
            weights[rows, level] = mixed.weights
            agreement[rows, level] = mixed.agreement
    progress(1.0, "features lifted")
    return Features(vectors, weights, agreement, encoder_id)


def _at_once(length: int) -> int:
    """Number of Gaussians per block for features of this length."""
    return max(AT_ONCE // max(length, 1), 1)


class _Mixed:
    """One level's features of a range of Gaussians: vectors (n, D), weights (n,), agreement (n,)."""

    def __init__(
        self, table: CellWeights, rows: slice, level: int, rounds: int = 0, given: Tensor | None = None
    ) -> None:
        n, length = rows.stop - rows.start, table.vectors.shape[1]
        padded = -(-length // LANES) * LANES
        out = np.zeros((n, padded), np.float32)
        if given is not None:
            out[:, :length] = given.numpy()
        weights, agreement = np.empty(n, np.float32), np.empty(n, np.float32)
        mix(
            threads(), rows.start, table.starts, table.cells, table.weights, table.view_of,
            np.ascontiguousarray(table.row_of[level]), table.pad_vectors(padded), padded, table.most, rounds,
            given is not None, out, weights, agreement,
        )  # fmt: skip
        self.vectors = torch.from_numpy(out)[:, :length]
        self.weights, self.agreement = torch.from_numpy(weights), torch.from_numpy(agreement)


def judge_features(table: CellWeights, features: Features, *, progress: Progress = silent) -> Features:
    """The features with weights and agreement measured against the masks; vectors or codes stay unchanged."""
    n, length = len(features), table.vectors.shape[1]
    weights, agreement = torch.empty(n, table.levels), torch.empty(n, table.levels)
    for level in range(table.levels):
        for rows in blocks(n, _at_once(length)):
            progress((level + rows.start / max(n, 1)) / table.levels, "comparing features with the photos'")
            mixed = _Mixed(table, rows, level, given=features.unit(level, rows))
            weights[rows, level], agreement[rows, level] = mixed.weights, mixed.agreement
    return Features(features.vectors, weights, agreement, features.encoder_id, features.decoders)
