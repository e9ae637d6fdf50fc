"""Masks by SAM: for every point of a grid the subpart, part and whole that contain it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...progress import Progress, silent
from ..encoders.checkpoints import SAM, Checkpoint, explain_misfit, open_checkpoint
from .segments import Segments, number_masks

LEVELS = 3
"""Subpart, part, whole: SAM's masks for one point, by size."""
POINTS_A_SIDE = 32
LEAST_IOU, LEAST_STABILITY, LEAST_AREA = 0.7, 0.85, 100
"""The paper's settings: IoU as predicted, IoU between the mask at logits above 1 and above -1, pixels of the photo."""
SAME_IOU = 0.7
"""Of two masks of a level with a larger IoU than this, the better one stays."""
BATCH, BLOCK = 32, 128
"""Points per batch; masks compared with each other at once."""


@dataclass(frozen=True, eq=False)
class _Masks:
    """Masks of one level on a coarse grid over the photo.

    logits: (M, h, w) float16, above 0 inside; scores: (M,) predicted IoU times stability; areas: (M,) cells inside.
    """

    logits: Tensor
    scores: Tensor
    areas: Tensor

    def pick(self, rows: Tensor) -> _Masks:
        return _Masks(self.logits[rows], self.scores[rows], self.areas[rows])


@dataclass(frozen=True, eq=False)
class SamSegmenter:
    """A segmenter (see `Segmenter`) on an opened checkpoint."""

    checkpoint: Checkpoint

    @classmethod
    def open(cls, name: str, *, allow_download: bool = False) -> SamSegmenter:
        """Open a SAM checkpoint by local folder or hub name.

        Raises:
            EncoderError: it is missing, unsafe, damaged, or does not do what a checkpoint of its kind must.
        """
        segmenter = cls(open_checkpoint(SAM, name, allow_download=allow_download))
        with explain_misfit(SAM, name):
            segmenter._answers(segmenter._embed(np.zeros((8, 8, 3), np.uint8)), torch.full((1, 2), 0.5), 1.0)
        return segmenter

    @property
    def identity(self) -> str:
        return self.checkpoint.identity

    def segment(self, image: NDArray[np.uint8], *, progress: Progress = silent) -> Segments:
        """See `Segmenter`; a pixel outside all masks is -1. A photo without any mask has a count of 0."""
        height, width = image.shape[:2]
        seen = self._embed(image)
        steps = (torch.arange(POINTS_A_SIDE) + 0.5) / POINTS_A_SIDE
        points = torch.cartesian_prod(steps, steps).flip(-1)
        answers: list[list[_Masks]] = []
        for batch in points.split(BATCH):
            asked = BATCH * len(answers)
            progress(asked / len(points), f"running SAM at point {asked + 1} of {len(points)}")
            answers.append(self._answers(seen, batch, LEAST_AREA / (height * width)))
        labels = np.full((LEVELS, height, width), -1, np.int32)
        for level in range(LEVELS):
            found = [answer[level] for answer in answers]
            _paint(labels[level], _remove_covered(_Masks(*map(torch.cat, zip(*map(_fields, found), strict=True)))))
        return number_masks(labels)

    @torch.inference_mode()
    def _embed(self, image: NDArray[np.uint8]) -> _Seen:
        model = self.checkpoint.model
        shown = self.checkpoint.pictures(images=image, return_tensors="pt")
        embedding = model.get_image_embeddings(shown["pixel_values"].to(model.device, model.dtype))
        height, width = (int(side) for side in shown["reshaped_input_sizes"][0])
        return _Seen(embedding, height, width)

    @torch.inference_mode()
    def _answers(self, seen: _Seen, points: Tensor, least_share: float) -> list[_Masks]:
        """The accepted masks of each level, small ones first, at points (P, 2), x and y as shares of the photo.

        least_share: the smallest area, as a share of the photo.
        """
        model = self.checkpoint.model
        at = (points * torch.tensor([seen.width, seen.height])).to(model.device, model.dtype)
        output = model(image_embeddings=seen.embedding, input_points=at[None, :, None], multimask_output=True)
        logits, predicted = output.pred_masks[0].float().cpu(), output.iou_scores[0].float().cpu()
        cells = logits.shape[-1] / model.config.vision_config.image_size  # the rest of the square is padding
        logits = logits[..., : max(1, round(seen.height * cells)), : max(1, round(seen.width * cells))]
        order = (logits > 0).sum((-2, -1)).argsort(dim=1, stable=True)
        least = least_share * logits[0, 0].numel()
        return [
            _find_good(logits[torch.arange(len(points)), which], predicted.gather(1, which[:, None])[:, 0], least)
            for which in order.unbind(1)
        ]


@dataclass(frozen=True, eq=False)
class _Seen:
    """The output of SAM's encoder for a photo, shared by all points; height, width: the photo in the model's square."""

    embedding: Tensor
    height: int
    width: int


def _fields(masks: _Masks) -> tuple[Tensor, ...]:
    return masks.logits, masks.scores, masks.areas


def _find_good(logits: Tensor, predicted: Tensor, least: float) -> _Masks:
    """Find which of (P, h, w) masks, with (P,) predicted IoU, are accurate, stable and have at least `least` cells."""
    areas, strict, lenient = ((logits > threshold).sum((-2, -1)) for threshold in (0.0, 1.0, -1.0))
    stability = strict / lenient.clamp_min(1)
    good = (predicted >= LEAST_IOU) & (stability >= LEAST_STABILITY) & (areas >= max(least, 1.0))
    return _Masks(logits.half(), predicted * stability, areas).pick(good.nonzero()[:, 0])


def _remove_covered(masks: _Masks) -> _Masks:
    """Remove masks that a mask of a higher score covers already."""
    masks = masks.pick(masks.scores.argsort(descending=True, stable=True))
    inside = (masks.logits > 0).flatten(1)
    stays = torch.ones(len(inside), dtype=torch.bool)
    for start in range(0, len(inside), BLOCK):
        rows = slice(start, start + BLOCK)
        mine = inside[rows].float()
        common = torch.cat([mine @ others.float().T for others in inside.split(BLOCK)], dim=1)
        same = common > SAME_IOU * (masks.areas[rows, None] + masks.areas - common)
        for row, twins in enumerate(same, start=start):
            if stays[row]:
                stays[row + 1 :] &= ~twins[row + 1 :]
    return masks.pick(stays.nonzero()[:, 0])


def _paint(labels: NDArray[np.int32], masks: _Masks) -> None:
    """Draw masks into (H, W) labels, large ones first, so that small ones stay visible."""
    height, width = labels.shape
    rows, columns = _stretch(masks.logits.shape[1], height), _stretch(masks.logits.shape[2], width)
    for number, index in enumerate(masks.areas.argsort(descending=True, stable=True).tolist()):
        logits = masks.logits[index].float()
        vertical, horizontal = _reach((logits > 0).any(1), height), _reach((logits > 0).any(0), width)
        drawn = rows[vertical] @ logits @ columns[horizontal].T
        labels[vertical, horizontal][(drawn > 0).numpy()] = number


def _stretch(cells: int, size: int) -> Tensor:
    """(size, cells) weights for bilinear enlargement along one axis."""
    at = ((torch.arange(size) + 0.5) * cells / size - 0.5).clamp(0, cells - 1)
    return (1.0 - (at[:, None] - torch.arange(cells)).abs()).clamp_min(0.0)


def _reach(used: Tensor, size: int) -> slice:
    """The pixels, of `size`, that used cells and their neighbours affect; used: (cells,) bool, some true."""
    cells, at = len(used), used.nonzero()[:, 0]
    first, last = int(at[0]) - 1, int(at[-1]) + 2
    return slice(max(0, first * size // cells), min(size, -(-last * size // cells)))
