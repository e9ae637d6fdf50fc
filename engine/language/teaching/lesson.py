"""Teaches a word in a scene: from examples that a user gave to a word that prompts understand."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...errors import EncoderError, VocabularyError
from ..encoders.encoder import Encoder, sees_fruit
from ..features.features import Features
from ..prompts.relevancy import LEAST_PRIOR, check_encoder, check_taught, relevancy
from ..taught.name import word_name
from ..taught.word import MOST_NUMBERS, MOST_THUMBNAILS, MOST_VECTORS, Example, TaughtWord
from ..vocabulary import CONCEPTS
from .learning import Examples, contradiction, learn
from .region import Ground

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_ROWS = 400
"""Gaussians of one example that are learnt from; of more, an even selection."""


@dataclass(frozen=True, eq=False)
class Mark:
    """An example in the scene. positive: it shows the word; place: where it came from, for people; rows: which
    Gaussians of `Ground` it has; thumbnail: (64, 64, 3) uint8 sRGB, None without a photo."""

    positive: bool
    place: str
    rows: IntArray
    thumbnail: Tensor | None = None


class Lesson:
    """A word that is taught in one scene, again with every example that is added or taken away."""

    def __init__(
        self, name: str, ground: Ground, features: Features, encoder: Encoder, start: TaughtWord | None = None
    ) -> None:
        """ground: of the features' Gaussians; start: what is known of the word from other scenes.

        Raises:
            VocabularyError: it cannot be the name of a word, or `start` is another word.
            EncoderError: the features, or `start`, are of another encoder or of an earlier version.
        """
        check_encoder(features, encoder)
        check_taught(features, encoder)
        self.name, self._ground, self._encoder_id, self._start = word_name(name), ground, encoder.identity, start
        if start is not None and start.name != self.name:
            raise VocabularyError(f"The examples are of the word '{start.name}', not of '{self.name}'")
        if start is not None and start.encoder_id != encoder.identity:
            raise EncoderError(
                f"The word '{start.name}' was taught with the encoder {start.encoder_id}, not with {encoder.identity}. "
                "Teach it again"
            )
        if start is not None and len(start.weights) != ground.evidence.shape[1]:
            raise EncoderError(
                f"The word '{start.name}' takes {len(start.weights)} numbers and these features have "
                f"{ground.evidence.shape[1]}. Teach it again in a result of these settings"
            )
        self._prior = self._prior_of(features, encoder)

    def _prior_of(self, features: Features, encoder: Encoder) -> FloatArray:
        """(M,) log odds of the built-in word of this name."""
        if self.name not in CONCEPTS or not sees_fruit(encoder):  # CLIP knows every word, so well as it can
            return np.zeros(len(self._ground.rows))
        said = relevancy(features, encoder.with_words({}), [self.name])
        logit: FloatArray = torch.logit(said.double(), eps=LEAST_PRIOR).numpy()[self._ground.rows]
        return logit

    def word(self, marks: Sequence[Mark], *, notes: str = "", licence: str = "") -> TaughtWord:
        """The word learnt from these examples and from those that it starts with.

        Raises:
            VocabularyError: there is no example that `learn` needs, or a positive one and a negative one are the same.
        """
        shown = [select_evenly(mark.rows, MOST_ROWS) for mark in marks]
        own = np.concatenate([np.zeros(0, np.int64), *shown])
        vectors = torch.from_numpy(self._ground.evidence[own]).half()
        positive = torch.tensor([mark.positive for mark in marks], dtype=torch.bool)
        sizes = torch.tensor([len(rows) for rows in shown], dtype=torch.int64)
        groups = torch.arange(len(marks)).repeat_interleave(sizes)
        prior = torch.from_numpy(self._prior[own]).float()
        signs = positive[groups] if len(marks) else torch.zeros(0, dtype=torch.bool)
        examples = tuple(Example(mark.positive, mark.place, len(mark.rows)) for mark in marks)
        pictures = [mark.thumbnail for mark in marks if mark.thumbnail is not None]
        if self._start is not None:
            old = self._start
            groups = torch.cat([old.groups, groups + len(old.examples)])
            vectors, prior = torch.cat([old.vectors, vectors]), torch.cat([old.prior, prior])
            signs, examples = torch.cat([old.positive, signs]), (*old.examples, *examples)
            pictures = [*old.thumbnails, *pictures]
        kept = _select_within(groups, min(MOST_VECTORS, MOST_NUMBERS // vectors.shape[1]))
        vectors, prior, signs, groups = vectors[kept], prior[kept], signs[kept], groups[kept]
        learnt = Examples(vectors.double().numpy(), signs.numpy(), prior.double().numpy(), groups.numpy())
        background = self._ground.sample_background(self._prior)
        if (pair := contradiction(learnt, background)) is not None:
            one, other = (examples[number].place for number in pair)
            raise VocabularyError(
                f"{one} shows '{self.name}' and {other} does not, but they look the same. Take one of the two away"
            )
        weights, bias = learn(learnt, background)
        taught = TaughtWord(
            self.name, self._encoder_id, weights, bias, vectors, signs, prior, groups, examples,
            notes=notes or ("" if self._start is None else self._start.notes),
            licence=licence or ("" if self._start is None else self._start.licence),
        )  # fmt: skip
        return dataclasses.replace(taught, thumbnails=torch.stack(pictures[:MOST_THUMBNAILS])) if pictures else taught


def select_evenly(rows: IntArray, most: int) -> IntArray:
    """Select at most `most` of the rows, evenly."""
    return rows if len(rows) <= most else rows[np.linspace(0, len(rows) - 1, most).astype(np.int64)]


def _select_within(groups: Tensor, most: int) -> Tensor:
    """Select the places of at most `most` of the rows whose examples are given (n,), the same number of each large
    example; of more examples than that, an even selection."""
    if len(groups) <= most:
        return torch.arange(len(groups))
    own = groups.numpy()
    _, first, place, sizes = np.unique(own, return_index=True, return_inverse=True, return_counts=True)
    each = max(1, most // len(first))
    order = np.argsort(place, kind="stable")
    starts = np.cumsum(sizes) - sizes
    rank = np.empty(len(own), np.int64)
    rank[order] = np.arange(len(own)) - starts[place[order]]
    size = sizes[place]
    kept = (size <= each) | (rank == 0) | (rank * each // size > (rank - 1) * each // size)
    return torch.from_numpy(select_evenly(np.flatnonzero(kept), most))
