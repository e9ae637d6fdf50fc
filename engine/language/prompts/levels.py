"""Which level of masks answers a word: subpart, part or whole."""

from __future__ import annotations

import torch
from torch import Tensor

SUREST = 1e-3
"""Share of what the photos drew that decides how sure a level is: a fruit or two, so that rare things are found."""


def best_level(answers: Tensor, weights: Tensor) -> int:
    """The level that is surest of a word, as LangSplat chooses it (Qin et al. 2024, section 3.4), but in 3D.

    answers: (L, N) probabilities or cosines; weights: (L, N) pixels drawn. A level is as sure as the mean answer of the
    Gaussians that answer highest and together drew a thousandth of all pixels: the single highest is noise. Of equally
    sure levels the first.
    """
    if len(answers) == 1:
        return 0
    return int(torch.stack([_confidence(each, drew) for each, drew in zip(answers, weights, strict=True)]).argmax())


def _confidence(answers: Tensor, weights: Tensor) -> Tensor:
    order = answers.argsort(descending=True, stable=True)
    drawn = weights[order].double()
    before = drawn.cumsum(0) - drawn
    counts = (SUREST * drawn.sum() - before).clamp_min(0.0).minimum(drawn)
    return (answers[order] * counts).sum() / counts.sum().clamp_min(1e-12)
