"""Prompts such as "red apple": fruit are found by their kind, and then chosen by their colour.

Every fruit has one colour, the one that most of what shows it speaks for. So the counts of all colours add up to the
count of the kind.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ...splatting.gaussians import Gaussians
from ..colours import colour_words, fruit_colours
from ..encoders.encoder import ColourSplit, Encoder, splits_colours
from ..features.photo_features import PhotoFeatures
from ..vocabulary import COLOURS, FRUIT_COLOURS


@dataclass(frozen=True, eq=False)
class ColourChoice:
    """split: the A colours, and which of them are asked for; gaussians: (N, A) how much each Gaussian says for them;
    photos: the pixels that may be fruit, None without photos."""

    split: ColourSplit
    gaussians: NDArray[np.float32]
    photos: PhotoFeatures | None

    @classmethod
    def of(cls, split: ColourSplit, gaussians: Gaussians, photos: PhotoFeatures | None) -> ColourChoice:
        """The choice among the fruit of a scene."""
        return cls(split, _weigh_words(gaussians.base_colors, split), photos)

    @property
    def asked(self) -> NDArray[np.bool_]:
        """(A,) whether the prompt asks for each colour."""
        return np.array(self.split.asked, bool)

    def pixels(self) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float32]]]:
        """Of each photo the rows (H, W) of its pixels in what they say for the colours (k + 1, A); pixels that were not
        kept have the last row, of zeros."""
        if self.photos is None:
            return
        for ((height, width), places, _), said in zip(self.photos.iterate_colours(), self._said_by_photos, strict=True):
            rows = np.full(height * width, len(places))
            rows[places.numpy()] = np.arange(len(places))
            yield rows.reshape(height, width), said

    @cached_property
    def _said_by_photos(self) -> list[NDArray[np.float32]]:
        """Of each photo what its pixels say for the colours, and a last row of zeros (k + 1, A)."""
        photos = self.photos.iterate_colours() if self.photos is not None else ()
        return [np.pad(_weigh_words(pixels, self.split), ((0, 1), (0, 0))) for _, _, pixels in photos]


def split_by_colour(encoder: Encoder, prompts: Sequence[str], negatives: Sequence[str]) -> ColourSplit | None:
    """Return the prompts without their colours; None if colours choose nothing, or the encoder does not separate them.

    Raises:
        VocabularyError: an unknown word.
    """
    return encoder.split_colours(prompts, negatives) if splits_colours(encoder) else None


def _weigh_words(pixels: Tensor, split: ColourSplit) -> NDArray[np.float32]:
    """Return (N, A) how much pixels (N, 3) say for each word, for the colour of fruit if all are colours of fruit."""
    pixels, of_fruit = pixels.detach().float().cpu(), set(split.words) <= set(FRUIT_COLOURS)
    said, known = (fruit_colours(pixels, split.kinds), FRUIT_COLOURS) if of_fruit else (colour_words(pixels), COLOURS)
    return said[:, [known.index(word) for word in split.words]].numpy()
