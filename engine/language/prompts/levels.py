"""The level of masks that matches a word best: subpart, part or whole."""

from __future__ import annotations

import torch
from torch import Tensor

TOP_SHARE = 1e-3
"""Share of all rendered pixels that decides the confidence of a level: a fruit or two, so that rare objects are
found."""


def best_level(answers: Tensor, weights: Tensor) -> int:
    """The level with the highest confidence for a word, chosen as by LangSplat (Qin et al. 2024, section 3.4), but in
    3D.

    answers: (L, N) probabilities or cosines; weights: (L, N) pixels of each Gaussian. The confidence of a level is the
    mean answer of the Gaussians with the highest answers that together cover a thousandth of all pixels, because the
    single highest is noise. Of equal levels the first is chosen.
    """
    if len(answers) == 1:
        return 0
    return int(torch.stack([_confidence(each, drew) for each, drew in zip(answers, weights, strict=True)]).argmax())


def _confidence(answers: Tensor, weights: Tensor) -> Tensor:
    order = answers.argsort(descending=True, stable=True)
    drawn = weights[order].double()
    before = drawn.cumsum(0) - drawn
    counts = (TOP_SHARE * drawn.sum() - before).clamp_min(0.0).minimum(drawn)
    return (answers[order] * counts).sum() / counts.sum().clamp_min(1e-12)
