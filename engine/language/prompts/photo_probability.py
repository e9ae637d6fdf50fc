"""The probability that each pixel of the photos matches the prompt."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..encoders.encoder import Encoder
from ..features.features import Features
from ..features.photo_features import PhotoFeatures
from .prior import kind_shares, weighed_by
from .relevancy import Words, answers_of, check_encoder, understood, union

Map = NDArray[np.float32]
"""(H, W) probability of each pixel of a photo."""


def photo_probabilities(
    photos: PhotoFeatures, features: Features, encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str] = ()
) -> list[Map] | None:
    """The map of each photo: what `relevancy` gives Gaussians, for pixels; 0 where no fruit is likely.

    features: of the Gaussians, whose kinds of fruit are those of the scene. None if a prompt names no kind of fruit,
    because of other objects the photos keep no features.

    Raises:
        EncoderError: the features were made by another encoder.
        VocabularyError: an unknown word, or no prompt.
    """
    check_encoder(features, encoder)
    sought, excluded = _asked(encoder, prompts, features, sought=True), None
    if not bool(sought.words.named.any(1).all()):
        return None
    if negatives:
        excluded = _asked(encoder, negatives, features, sought=False)
    maps = []
    for (height, width), places, vectors in photos.photos():
        found = sought.probability(vectors, encoder)
        if excluded is not None:
            found = found * (1.0 - excluded.probability(vectors, encoder))
        drawn = torch.zeros(height * width)
        drawn[places] = found
        maps.append(drawn.reshape(height, width).numpy())
    return maps


class _Asked:
    """Words as a scene understands them."""

    def __init__(self, words: Words, shares: Tensor) -> None:
        self.words, self._shares = words, shares

    def probability(self, vectors: Tensor, encoder: Encoder) -> Tensor:
        """(n,) of any of the words for unit features (n, D)."""
        weighed = weighed_by(vectors, self.words.kinds, self._shares)
        return union(answers_of(vectors, weighed, self.words), self.words.texts, encoder)


def _asked(encoder: Encoder, words: Sequence[str], features: Features, *, sought: bool) -> _Asked:
    understood_words = understood(encoder, words, sought=sought)
    shares = kind_shares(features.unit(0), features.weights[:, 0], understood_words.kinds, understood_words.believed)
    return _Asked(understood_words, shares)
