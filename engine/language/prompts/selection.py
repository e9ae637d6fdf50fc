"""Selects the Gaussians that match the prompt: by calibrated probability, or by the paper's two thresholds."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from ...config import CountConfig
from ...errors import VocabularyError
from ..encoders.encoder import Encoder
from ..features.features import Features, blocks
from .levels import best_level
from .relevancy import MIN_WEIGHT, ROWS, check_encoder, check_prompts, relevancy, taught_words


def select(
    features: Features,
    encoder: Encoder,
    prompts: Sequence[str],
    negatives: Sequence[str],
    config: CountConfig,
    means: Tensor,
) -> Tensor:
    """(N,) float32 in [0, 1], how far each Gaussian matches the prompt, by the method in the settings.

    means: (N, 3) the positions of the Gaussians, for smoothing over neighbours.

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, no prompt, or a prompt that a negative rules out altogether.
    """
    if config.select == "dual":
        found = dual_threshold(
            features, encoder, prompts, negatives, tau_pos=config.tau_pos, tau_neg=config.tau_neg
        ).float()
    else:
        found = relevancy(features, encoder, prompts, negatives)
    return smooth(found, features.weights.amax(1), means, config.neighbours) if config.neighbours else found


def dual_threshold(
    features: Features,
    encoder: Encoder,
    prompts: Sequence[str],
    negatives: Sequence[str] = (),
    *,
    tau_pos: float,
    tau_neg: float,
) -> Tensor:
    """(N,) bool: s⁺ > τ_pos and s⁻ < τ_neg, s the largest cosine to a positive and to a negative (eq. 10 and 11).

    Without negatives only s⁺ counts. The level of masks with the highest s⁺ is used. A Gaussian with almost no pixels
    is never selected.

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, no prompt, a prompt that a negative rules out altogether, or a taught word.
    """
    check_encoder(features, encoder)
    check_prompts(encoder, prompts, negatives)
    if taught_words(encoder, [*prompts, *negatives]):
        raise VocabularyError("A taught word has no cosine, which --count.select dual needs. Use calibrated")
    positive = _largest_cosines(features, encoder.encode_text(prompts))
    seen = features.weights.T >= MIN_WEIGHT
    level = best_level(torch.where(seen, positive, -1.0), features.weights.T)
    selected = seen[level] & (positive[level] > tau_pos)
    if negatives:
        selected &= _largest_cosines(features, encoder.encode_text(negatives))[level] < tau_neg
    return selected


def _largest_cosines(features: Features, text: Tensor) -> Tensor:
    """(L, N) largest cosine of each Gaussian to a row of text (P, D), by level (eq. 10)."""
    cosines = torch.empty(features.levels, len(features))
    for level in range(features.levels):
        for rows in blocks(len(features), ROWS):
            cosines[level, rows] = (features.unit(level, rows) @ text.T).amax(1)
    return cosines


def smooth(probability: Tensor, weights: Tensor, means: Tensor, neighbours: int) -> Tensor:
    """Average probabilities (N,) over each Gaussian and its nearest `neighbours`, weighted by pixels.

    weights: (N,) those pixels. A Gaussian without pixels keeps its own probability.
    """
    usable = torch.isfinite(means).all(1) & (weights >= MIN_WEIGHT)
    if not usable.any():
        return probability
    places = means[usable].double().numpy()
    _, near = cKDTree(places).query(places, k=range(1, min(neighbours + 1, len(places)) + 1))
    index = torch.from_numpy(near)
    drawn, given = weights[usable][index], probability[usable][index]
    out = probability.clone()
    out[usable] = (drawn * given).sum(1) / drawn.sum(1)
    return out
