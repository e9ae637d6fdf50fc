"""The interface of an encoder of words and photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..taught.word import TaughtWord


@dataclass(frozen=True, eq=False)
class Question:
    """A question about a feature: is it any of `positives` rather than any of `negatives`?

    positives: (P, D), negatives: (M, D) unit text vectors. `score` says what a cosine c means to this encoder: itself,
    or ("posterior") the square root of a probability, so that its score is log c². The answer, with s the scores, is
    σ((logsumexp s⁺ − logsumexp s⁻) / temperature − bias), the calibrated margin.
    """

    positives: Tensor
    negatives: Tensor
    score: Literal["cosine", "posterior"]
    temperature: float
    bias: float


@dataclass(frozen=True, eq=False)
class TaughtQuestion:
    """Is it what the word was taught with? prior: the questions of the built-in word that it refines; none for a new
    word.

    The answer is σ(ℓ + logit of the prior's answer), with ℓ the log odds of the word (see `TaughtWord.logit`).
    """

    word: TaughtWord
    prior: Sequence[Question]


class Encoder(Protocol):
    """Maps words to unit vectors in the space of photo features, which a `DenseEncoder` or a `CropEncoder` computes."""

    @property
    def identity(self) -> str:
        """Name and fingerprint of the weights; features of another identity cannot be queried with this encoder."""
        ...

    @property
    def dimension(self) -> int:
        """D, the length of a feature."""
        ...

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """(P, D) unit float32. Raises VocabularyError for an unknown word."""
        ...

    @property
    def taught(self) -> Mapping[str, TaughtWord]:
        """Words that users taught, by name; asked for one by one, because a file may be damaged."""
        ...

    def with_words(self, taught: Mapping[str, TaughtWord]) -> Encoder:
        """The same encoder with other taught words."""
        ...

    def questions(self, prompt: str) -> Sequence[Question | TaughtQuestion]:
        """The questions whose answers multiply to the probability of `prompt`.

        Raises:
            VocabularyError: an unknown word.
            FormatError, EncoderError: a taught word cannot be used.
        """
        ...

    def kinds(self) -> Tensor:
        """(K, D) orthonormal text vectors of kinds of fruit, of which a scene usually has one; K may be 0."""
        ...

    def meaning(self, prompt: str) -> str:
        """A text that is the same for all phrases with one meaning, such as synonyms."""
        ...

    def label(self, prompt: str) -> str:
        """The label of fruit that the prompt names: "Red Apples" → "red apple"."""
        ...

    def separates(self, one: str, other: str) -> bool:
        """Whether nothing can match both phrases; False if that is not known."""
        ...

    def excludes(self, prompt: str, negative: str) -> bool:
        """Whether everything that matches `prompt` also matches `negative`."""
        ...


@dataclass(frozen=True, eq=False)
class ColourSplit:
    """Prompts for fruit of some colours, in two parts: fruit of a kind, and their colour.

    prompts, negatives: without colours; kinds: what the fruit may be; words: A colours, of which every fruit has one;
    asked: (A,) which of them the prompts ask for.
    """

    prompts: Sequence[str]
    negatives: Sequence[str]
    kinds: Sequence[str]
    words: Sequence[str]
    asked: Sequence[bool]


class ColourEncoder(Encoder, Protocol):
    """An encoder whose features tell colours apart from kinds of fruit."""

    def split_colours(self, prompts: Sequence[str], negatives: Sequence[str]) -> ColourSplit | None:
        """The prompts in two parts; None if no colour chooses among the fruit of one kind.

        Raises:
            VocabularyError: an unknown word.
        """
        ...


class KindEncoder(Encoder, Protocol):
    """An encoder that distinguishes kinds of fruit, and has a word for fruit of any kind."""

    @property
    def kind_words(self) -> Sequence[str]:
        """The word of each of the `kinds`."""
        ...

    def of_any_kind(self, prompt: str) -> str | None:
        """The prompt for fruit of any kind in the same colours: "red plum" → "red fruit".

        None if the prompt names no fruit, or already any kind.

        Raises:
            VocabularyError: an unknown word.
        """
        ...


class DenseEncoder(Encoder, Protocol):
    """An encoder that processes whole photos and needs no masks."""

    def scales_of(self, height: int, width: int, fruit: float | None = None) -> Sequence[float]:
        """The sizes at which a photo of height × width pixels is processed best, relative to it, the largest first.
        fruit: their width in the photo, in pixels, None if it is not known."""
        ...

    def encode_dense(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> Tensor:
        """(H, W, 3) sRGB → (H', W', D) unit float32 features that cover the same picture, row by row. scales: see
        `scales_of`, whose values without the width of fruit are used if none are given."""
        ...


@dataclass(frozen=True, eq=False)
class FruitView:
    """What an encoder sees in a photo. features: (H', W', D), those of `encode_dense`; offsets: (H', W', 2) how far
    right and down from the centre of its fruit each pixel lies, in radii of the fruit; embedding: (H', W', E) what
    taught words are learnt from."""

    features: Tensor
    offsets: Tensor
    embedding: Tensor


class FruitEncoder(DenseEncoder, Protocol):
    """An encoder that distinguishes single fruit in a photo."""

    @property
    def fruit_identity(self) -> str:
        """Name and fingerprint of all weights that `encode_fruit` uses, more than those of `identity`; what was kept of
        photos with another one cannot be used with this encoder."""
        ...

    @property
    def embedding_size(self) -> int:
        """E, the length of the embedding."""
        ...

    def encode_fruit(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> FruitView:
        """(H, W, 3) sRGB → everything that the encoder sees; scales: as of `encode_dense`."""
        ...


class CropEncoder(Encoder, Protocol):
    """An encoder that processes one masked object at a time."""

    def encode_crops(self, crops: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Pictures (h, w, 3) sRGB of any size, black outside their mask → (M, D) unit float32."""
        ...


def sees_whole(encoder: Encoder) -> TypeGuard[DenseEncoder]:
    """Whether an encoder processes whole photos."""
    return hasattr(encoder, "encode_dense")


def sees_fruit(encoder: Encoder) -> TypeGuard[FruitEncoder]:
    """Whether an encoder distinguishes single fruit in whole photos."""
    return hasattr(encoder, "encode_fruit")


def splits_colours(encoder: Encoder) -> TypeGuard[ColourEncoder]:
    """Whether an encoder tells colours apart from kinds of fruit."""
    return hasattr(encoder, "split_colours")


def names_kinds(encoder: Encoder) -> TypeGuard[KindEncoder]:
    """Whether an encoder names the kinds of fruit that it distinguishes."""
    return hasattr(encoder, "kind_words")


def sees_crops(encoder: Encoder) -> TypeGuard[CropEncoder]:
    """Whether an encoder processes masked objects."""
    return hasattr(encoder, "encode_crops")
