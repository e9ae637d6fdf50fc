"""The probability that each pixel of the photos matches the prompt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...errors import EncoderError
from ...progress import Progress, silent
from ...scene.camera import Scene
from ..encoders.encoder import Encoder, FruitEncoder
from ..features.features import Features
from ..features.lift import record_photos
from ..features.photo_features import PhotoFeatures
from .prior import kind_shares, weigh_kinds
from .relevancy import answers_of, check_encoder, check_taught, taught_words, telling_words, understand, union


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
    because of other objects the photos keep no features. For taught words the photos are those of `prepare_photos`.

    Raises:
        EncoderError: the features, or those of the photos, were made by another encoder.
        VocabularyError: an unknown word, or no prompt.
    """
    check_encoder(features, encoder)
    if not photos.are_of(encoder):
        raise EncoderError(
            f"The features of the photos were made by {photos.encoder_id}, which this version does not have. Count "
            "again from the photos"
        )
    sought = _Asked(encoder, prompts, features, sought=True)
    if not bool((sought.words.named.any(1) | sought.words.taught).all()):
        return None
    excluded = _Asked(encoder, negatives, features, sought=False) if negatives else None
    maps = []
    for (height, width), places, vectors, offsets, embedding in photos.photos():
        found = sought.probability(vectors, embedding)
        if excluded is not None:
            found = found * (1.0 - excluded.probability(vectors, embedding))
        drawn, off = torch.zeros(height * width), torch.zeros(height * width, 2)
        drawn[places], off[places] = found, offsets
        maps.append(PhotoMap(drawn.reshape(height, width).numpy(), off.reshape(height, width, 2).numpy()))
    return maps


def prepare_photos(
    photos: PhotoFeatures,
    scene: Scene,
    features: Features,
    encoder: FruitEncoder,
    prompts: Sequence[str],
    negatives: Sequence[str] = (),
    *,
    progress: Progress = silent,
) -> PhotoFeatures | None:
    """Prepare the features of the photos' pixels that a prompt needs: those that were kept, unless a word was taught.
    Then the encoder looks at the photos again, because what it kept may not show this fruit; None if they are missing.

    Raises:
        EncoderError, FormatError: a taught word cannot be used.
        SceneError: a photo cannot be read.
    """
    if not taught_words(encoder, [*prompts, *negatives]):
        return photos
    if len(scene.images) != len(scene.cameras):
        return None
    sought = _Asked(encoder, prompts, features, sought=True)
    return record_photos(scene, encoder, photos.seen_at, sought.probability, progress=progress)


class _Asked:
    """Words as the encoder and the Gaussians of a scene understand them."""

    def __init__(self, encoder: Encoder, words: Sequence[str], features: Features, *, sought: bool) -> None:
        self.words, self._encoder = understand(encoder, words, sought=sought), encoder
        if self.words.taught.any():
            check_taught(features, encoder, self.words.sizes)
        self._shares: Tensor | None = None
        if telling_words(self.words.named).any():
            self._shares = kind_shares(features.unit(0), features.weights[:, 0], self.words.kinds, self.words.believed)

    def probability(self, vectors: Tensor, embedding: Tensor) -> Tensor:
        """(n,) of any of the words for unit features (n, D), and the embedding (n, E) for taught words."""
        weighed = vectors if self._shares is None else weigh_kinds(vectors, self.words.kinds, self._shares)
        return union(answers_of(vectors, weighed, self.words, embedding), self.words.texts, self._encoder)
