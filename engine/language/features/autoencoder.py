"""The autoencoder of a scene: features of masks, hundreds of numbers, as codes of three (paper eq. 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn import functional

from ...config import EmbedConfig
from ...errors import EncoderError
from ...progress import Progress, silent
from .features import Perceptron

CODE = 3
"""Numbers of a code, d in the paper."""
ENCODER, DECODER = (256, 128, 64, 32, CODE), (16, 32, 64, 128, 256, 256)
"""Widths of the layers after the feature's D, and between the code and the D of the result."""
BATCH, LEARNING_RATE = 64, 7e-4
"""Batch size and learning rate."""
MOST_VECTORS = 10_000
"""Most features for training; of more, this many are sampled: a few minutes on one core."""


@dataclass(frozen=True, eq=False)
class Autoencoder:
    """Features ↔ codes, and the reconstruction quality.

    encode: (…, D) → (…, 3) unit codes; decode: (…, 3) → (…, D) unit features; cosine: mean cosine between training
    features and their reconstructions; l1: mean absolute difference; learnt: number of training features.
    """

    encode: Perceptron
    decode: Perceptron
    cosine: float
    l1: float
    learnt: int


def train_autoencoder(vectors: Tensor, config: EmbedConfig, *, progress: Progress = silent) -> Autoencoder:
    """Learn codes of features (M, D), unit, with d_ae = L1 + cosine distance, both over the feature axis.

    Codes lie on the unit sphere, like features, so that the length of their sum along a ray only says how much was
    rendered. Seeded; the same features, settings and machine give the same bytes.

    Raises:
        EncoderError: there is no feature, or one is not finite.
    """
    if len(vectors) == 0:
        raise EncoderError("No mask has a feature to learn codes from. Use other masks, or the embedded encoder")
    if not torch.isfinite(vectors).all():
        raise EncoderError(
            "A mask has a feature that is not a number. Encode in full precision, or check the encoder's weights"
        )
    generator = torch.Generator().manual_seed(config.seed)
    vectors = functional.normalize(vectors.detach().float(), dim=-1)
    if len(vectors) > MOST_VECTORS:
        vectors = vectors[torch.randperm(len(vectors), generator=generator)[:MOST_VECTORS].sort().values]
    encode = _layers((vectors.shape[1], *ENCODER), generator)
    decode = _layers((CODE, *DECODER, vectors.shape[1]), generator)
    learnt = [tensor.requires_grad_() for half in (encode, decode) for tensor in (*half.weights, *half.biases)]
    optimiser = torch.optim.Adam(learnt, lr=LEARNING_RATE, fused=True)
    for epoch in range(config.code_epochs):
        progress(epoch / config.code_epochs, f"learning codes, epoch {epoch + 1} of {config.code_epochs}")
        for chosen in torch.randperm(len(vectors), generator=generator).split(BATCH):
            given = vectors[chosen]
            optimiser.zero_grad()
            reconstruction_loss(decode(encode(given)), given).backward()
            optimiser.step()
    encode, decode = _detach(encode), _detach(decode)
    back = decode(encode(vectors))
    progress(1.0, "codes learnt")
    return Autoencoder(
        encode=encode,
        decode=decode,
        cosine=float((back * vectors).sum(-1).mean()),
        l1=float((back - vectors).abs().mean()),
        learnt=len(vectors),
    )


def train_autoencoders(
    levels: Sequence[Tensor], config: EmbedConfig, *, progress: Progress = silent
) -> tuple[Autoencoder, ...]:
    """One autoencoder for the features of all levels, each (M, D), or one per level if the settings ask for it.

    Raises:
        EncoderError: there is no feature, or one is not finite.
    """
    if not config.code_each_level:
        return (train_autoencoder(torch.cat(list(levels)), config, progress=progress),)

    def share(level: int) -> Progress:
        return lambda fraction, message: progress((level + fraction) / len(levels), f"level {level + 1}: {message}")

    return tuple(train_autoencoder(vectors, config, progress=share(level)) for level, vectors in enumerate(levels))


def reconstruction_loss(back: Tensor, given: Tensor) -> Tensor:
    """d_ae of eq. 6, mean over features (M, D): mean absolute difference + 1 - cosine."""
    return (back - given).abs().mean() + (1.0 - functional.cosine_similarity(back, given, dim=-1)).mean()


def _layers(widths: Sequence[int], generator: torch.Generator) -> Perceptron:
    """Linear layers with uniform starts of ±1/√in."""
    weights, biases = [], []
    for inside, outside in pairwise(widths):
        bound = 1.0 / math.sqrt(inside)
        weights.append((torch.rand(outside, inside, generator=generator) * 2.0 - 1.0) * bound)
        biases.append((torch.rand(outside, generator=generator) * 2.0 - 1.0) * bound)
    return Perceptron(tuple(weights), tuple(biases))


def _detach(half: Perceptron) -> Perceptron:
    return Perceptron(tuple(each.detach() for each in half.weights), tuple(each.detach() for each in half.biases))
