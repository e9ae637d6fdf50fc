"""The probability that each pixel of the photos matches the prompt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..encoders.encoder import Encoder
from ..features.features import Features
from ..features.photo_features import PhotoFeatures
from .prior import kind_shares, weighed_by
from .relevancy import answers_of, check_encoder, telling_words, understood, union


@dataclass(frozen=True, eq=False)
class PhotoMap:
    """probability: (H, W) of the prompt; offsets: (H, W, 2) how far right and down from the centre of its fruit each
    pixel lies, in radii, where the probability is not 0."""

    probability: NDArray[np.float32]
    offsets: NDArray[np.float32]


def photo_probabilities(
    photos: PhotoFeatures, features: Features, encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str] = ()
) -> list[PhotoMap] | None:
    """The map of each photo: what `relevancy` gives Gaussians, for pixels; 0 where no fruit is likely.

    features: of the Gaussians, whose kinds of fruit are those of the scene. None if a prompt names no kind of fruit,
    because of other objects the photos keep no features.

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, or no prompt.
    """
    check_encoder(features, encoder)
    sought = _Asked(encoder, prompts, features, sought=True)
    if not bool(sought.words.named.any(1).all()):
        return None
    excluded = _Asked(encoder, negatives, features, sought=False) if negatives else None
    maps = []
    for (height, width), places, vectors, offsets in photos.photos():
        found = sought.probability(vectors)
        if excluded is not None:
            found = found * (1.0 - excluded.probability(vectors))
        drawn, off = torch.zeros(height * width), torch.zeros(height * width, 2)
        drawn[places], off[places] = found, offsets
        maps.append(PhotoMap(drawn.reshape(height, width).numpy(), off.reshape(height, width, 2).numpy()))
    return maps


class _Asked:
    """Words as the encoder and the Gaussians of a scene understand them."""

    def __init__(self, encoder: Encoder, words: Sequence[str], features: Features, *, sought: bool) -> None:
        self.words, self._encoder = understood(encoder, words, sought=sought), encoder
        self._shares: Tensor | None = None
        if telling_words(self.words.named).any():
            self._shares = kind_shares(features.unit(0), features.weights[:, 0], self.words.kinds, self.words.believed)

    def probability(self, vectors: Tensor) -> Tensor:
        """(n,) of any of the words for unit features (n, D)."""
        weighed = vectors if self._shares is None else weighed_by(vectors, self.words.kinds, self._shares)
        return union(answers_of(vectors, weighed, self.words), self.words.texts, self._encoder)
