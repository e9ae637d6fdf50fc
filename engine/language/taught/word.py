"""A taught word: what tells its fruit from everything else, and its file."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...errors import FormatError, VocabularyError
from ...storage.files import read_tensors, write_tensors
from ..vocabulary import CONCEPTS
from .name import word_name

FORMAT = "fruitlangs-word-1"
SUFFIX = ".fruitword"
LARGEST_FILE = 16 << 20
"""Bytes of the largest file that is read."""
THUMBNAIL = 64
"""Side of a thumbnail, pixels."""
MOST_VECTORS, MOST_NUMBERS, MOST_THUMBNAILS = 20_000, 4_000_000, 64
"""Vectors of examples in a file, their numbers in all, and small pictures."""
TENSORS = ("weights", "vectors", "positive", "prior", "groups", "thumbnails")
"""Names of the tensors in a file."""


@dataclass(frozen=True)
class Example:
    """Where an example came from. positive: it shows the word; place: "IMG_12.jpg:1034,887", "fruit 7" or a file of
    boxes; gaussians: how many it has."""

    positive: bool
    place: str
    gaussians: int


@dataclass(frozen=True, eq=False)
class TaughtWord:
    """A logistic classifier of evidence (see `features.evidence`), and what it was learnt from.

    weights: (F,) float32; bias: float; encoder_id: identity of the encoder that the evidence is from; vectors: (n, F)
    float16 evidence of all examples, so that more can be added in another scene; positive: (n,) bool; prior: (n,)
    float32 log odds of the built-in word that is refined, else 0; groups: (n,) int64 place of each in `examples`;
    thumbnails: (T, THUMBNAIL, THUMBNAIL, 3) uint8 sRGB; notes, licence: texts for people.
    """

    name: str
    encoder_id: str
    weights: Tensor
    bias: float
    vectors: Tensor
    positive: Tensor
    prior: Tensor
    groups: Tensor
    examples: tuple[Example, ...] = ()
    thumbnails: Tensor = field(default_factory=lambda: torch.zeros(0, THUMBNAIL, THUMBNAIL, 3, dtype=torch.uint8))
    notes: str = ""
    licence: str = ""

    @property
    def refines(self) -> bool:
        """Whether it corrects the answer of a built-in word of the same name."""
        return self.name in CONCEPTS

    @property
    def identity(self) -> str:
        """A hash of everything that its answers depend on."""
        said = f"{self.name} {self.encoder_id} {self.bias!r}".encode()
        return hashlib.sha256(said + self.weights.numpy().tobytes()).hexdigest()[:16]

    def logit(self, evidence: Tensor) -> Tensor:
        """(…, F) evidence → (…) log odds of this word, to be added to those of the built-in word that it refines."""
        return evidence.float() @ self.weights + self.bias


def save_word(path: Path, word: TaughtWord) -> None:
    """Write the file atomically.

    Raises:
        OutputError: it cannot be written.
    """
    header = {
        "format": FORMAT,
        "name": word.name,
        "encoder_id": word.encoder_id,
        "bias": word.bias,
        "examples": [asdict(example) for example in word.examples],
        "notes": word.notes,
        "licence": word.licence,
    }
    tensors = {name: getattr(word, name).contiguous() for name in TENSORS}
    write_tensors(path, tensors, header)


def read_word(path: Path) -> TaughtWord:
    """Read a file that `save_word` wrote.

    Raises:
        FormatError: it is missing, damaged, or something else.
    """
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise ValueError(f"it is larger than {LARGEST_FILE >> 20} MB")
        tensors, header = read_tensors(path)
        if header["format"] != FORMAT:
            raise ValueError(f"it holds {header['format']}")
        word = _word(tensors, header)
    except (
        KeyError,
        TypeError,
        ValueError,
        AttributeError,
        OSError,
        OverflowError,
        RecursionError,
        VocabularyError,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FormatError(f"{path} holds no taught word ({reason}). Teach it again, or take the file away") from error
    return word


def _word(tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> TaughtWord:
    """Raises ValueError, or another error of a wrong type, if anything does not fit."""
    word = TaughtWord(
        name=str(header["name"]),
        encoder_id=str(header["encoder_id"]),
        bias=float(header["bias"]),
        **{name: tensors[name] for name in TENSORS},
        examples=tuple(
            Example(bool(each["positive"]), str(each["place"]), int(each["gaussians"])) for each in header["examples"]
        ),
        notes=str(header["notes"]),
        licence=str(header["licence"]),
    )
    n = len(word.vectors)
    fits = word.weights.dtype == torch.float32 and word.weights.ndim == 1 and 0 < n <= MOST_VECTORS
    fits &= word.vectors.dtype == torch.float16 and word.vectors.shape == (n, len(word.weights))
    fits &= word.positive.dtype == torch.bool and word.positive.shape == (n,)
    fits &= word.prior.dtype == torch.float32 and word.prior.shape == (n,)
    fits &= word.groups.dtype == torch.int64 and word.groups.shape == (n,)
    fits &= word.thumbnails.dtype == torch.uint8 and word.thumbnails.shape[1:] == (THUMBNAIL, THUMBNAIL, 3)
    if not fits:
        raise ValueError("its tensors do not fit")
    if bool(((word.groups < 0) | (word.groups >= len(word.examples))).any()):
        raise ValueError("a vector belongs to no example")
    numbers = (word.weights, word.vectors, word.prior, torch.tensor(word.bias))
    if not all(bool(torch.isfinite(each).all()) for each in numbers):
        raise ValueError("a number is not finite")
    if word_name(word.name) != word.name:
        raise ValueError(f"'{word.name}' is not a name of a word")
    return word
