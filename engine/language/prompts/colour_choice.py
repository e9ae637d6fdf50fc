"""Prompts such as "red apple": fruit are found by their kind, and then chosen by their colour.

Every fruit has one colour, that with the largest share of what shows it. So the counts of all colours add up to the
count of the kind.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ..encoders.encoder import ColourSplit, Encoder, splits_colours
from ..features.features import Features, blocks
from ..features.photo_features import PhotoFeatures

ROWS = 65_536
"""Gaussians whose colours are looked up at a time."""


@dataclass(frozen=True, eq=False)
class ColourChoice:
    """split: the A colours, and which of them are asked for; gaussians: (N, A) their shares of each Gaussian; photos:
    the features of pixels that may be fruit, None without photos."""

    split: ColourSplit
    gaussians: NDArray[np.float32]
    photos: PhotoFeatures | None

    @classmethod
    def of(cls, split: ColourSplit, features: Features, photos: PhotoFeatures | None) -> ColourChoice:
        """The choice among the fruit of a scene. features: of its Gaussians."""
        parts = [_shares(features.unit(0, rows), split.colours) for rows in blocks(len(features), ROWS)]
        return cls(split, torch.cat(parts).numpy(), photos)

    @property
    def asked(self) -> NDArray[np.bool_]:
        """(A,) whether the prompt asks for each colour."""
        return np.array(self.split.asked, bool)

    def pixels(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """Of each photo the rows (H, W) of its pixels in its shares (k + 1, A); pixels that were not kept have the last
        row, of zeros."""
        if self.photos is None:
            return
        for (height, width), places, vectors, _ in self.photos.photos():
            rows = np.full(height * width, len(places))
            rows[places.numpy()] = np.arange(len(places))
            shares = _shares(vectors, self.split.colours).numpy()
            yield rows.reshape(height, width), np.concatenate([shares, np.zeros((1, shares.shape[1]), np.float32)])


def colour_split(encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str]) -> ColourSplit | None:
    """The prompts without their colours; None if colours choose nothing, or the encoder does not separate them.

    Raises:
        VocabularyError: an unknown word.
    """
    return encoder.split_colours(prompts, negatives) if splits_colours(encoder) else None


def _shares(vectors: Tensor, colours: Tensor) -> Tensor:
    """(N, A) shares of the colours (A, D) in unit features (N, D); they sum to 1, also where it is too dark for any."""
    shares = (vectors.float() @ colours.T).square()
    return shares / shares.sum(-1, keepdim=True).clamp_min(1e-12)
