"""Taught words made by hand, for tests."""

from __future__ import annotations

import torch
from torch import Tensor

from fruitlangs.engine.language.encoders.embedded import Calibration, EmbeddedEncoder
from fruitlangs.engine.language.encoders.network import Network
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.taught.word import THUMBNAIL, Example, TaughtWord
from fruitlangs.engine.language.vocabulary import COLOURS, CONCEPTS

IDENTITY = "test"


def small_encoder(*words: TaughtWord) -> EmbeddedEncoder:
    """An encoder with an untrained network that knows these words."""
    network = Network(len(CONCEPTS), widths=(2, 2, 2, 2), depths=(0, 0, 0, 0))
    return EmbeddedEncoder(network.fuse(), Calibration(), IDENTITY, {word.name: word for word in words})


def word_of(name: str, *weights: float, bias: float = 0.0, encoder_id: str = IDENTITY) -> TaughtWord:
    """A word with these weights and two examples, of which the first shows it."""
    vectors = torch.zeros(2, len(weights), dtype=torch.float16)
    vectors[0] = 1.0
    return TaughtWord(
        name=name,
        encoder_id=encoder_id,
        weights=torch.tensor(weights),
        bias=bias,
        vectors=vectors,
        positive=torch.tensor([True, False]),
        prior=torch.zeros(2),
        groups=torch.tensor([0, 1]),
        examples=(Example(True, "IMG_1.jpg:10,20", 1), Example(False, "fruit 7", 1)),
        thumbnails=torch.full((1, THUMBNAIL, THUMBNAIL, 3), 90, dtype=torch.uint8),
        notes="from the tree at the gate",
        licence="CC0",
    )


def feature_of(colour: str, **concepts: float) -> Tensor:
    """A unit feature of this colour with these concept probabilities, the rest spread over the other concepts."""
    shares = torch.full((len(CONCEPTS),), (1.0 - sum(concepts.values())) / (len(CONCEPTS) - len(concepts)))
    for word, share in concepts.items():
        shares[CONCEPTS.index(word)] = share
    colours = torch.full((len(COLOURS),), 0.01 / (len(COLOURS) - 1))
    colours[COLOURS.index(colour)] = 0.99
    return torch.cat([shares, colours]).mul(0.5).sqrt()


def features_with(vectors: Tensor, embedding: Tensor | None, weight: float = 10.0) -> Features:
    """Unit features (N, D) of Gaussians with their embedding (N, E), each seen by `weight` pixels."""
    seen = torch.full((len(vectors), 1), weight)
    half = None if embedding is None else embedding.half()
    return Features(vectors[:, None], seen, torch.ones_like(seen), IDENTITY, embedding=half)
