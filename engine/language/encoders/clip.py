"""CLIP and SigLIP: any word, for one masked object of a photo at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ...errors import EncoderError, VocabularyError
from ..taught.library import Library
from ..taught.word import TaughtWord
from ..vocabulary import find_taught_name, parse
from .checkpoints import CLIP, Checkpoint, explain_misfit, open_checkpoint
from .encoder import Question, TaughtQuestion

TEMPLATE = "a photo of {article} {words}"
"""Templates of prompts: these models were trained on captions."""
NEGATIVES = {
    "object": "objects",
    "thing": "things",
    "leaf": "leaves",
    "branch": "branches",
    "trunk": "trunks",
    "soil": "soils",
    "grass": "grasses",
    "sky": "skies",
    "post": "posts",
    "background": "backgrounds",
}
"""Plain words that every prompt is compared with, and their plurals: a negative that equals the prompt is left out."""
TEMPERATURE = 0.1
"""Temperature of the margin between cosines; LangSplat's 1/T is 10 (Qin et al. 2024, eq. 8)."""
BATCH = 32
"""Crops per batch."""


@dataclass(frozen=True, eq=False)
class ClipEncoder:
    """A crop encoder (see `CropEncoder`) on a checkpoint that `open` checked."""

    checkpoint: Checkpoint
    dimension: int
    taught: Mapping[str, TaughtWord] = field(default_factory=dict)
    _read: dict[str, Tensor] = field(default_factory=dict, repr=False)

    @classmethod
    def open(cls, name: str, *, allow_download: bool = False, words: Path | None = None) -> ClipEncoder:
        """Open a ViT CLIP or SigLIP checkpoint by local folder or hub name. words: folder of taught words.

        Raises:
            EncoderError: it is missing, unsafe, damaged, or does not do what a checkpoint of its kind must.
        """
        checkpoint = open_checkpoint(CLIP, name, allow_download=allow_download)
        with explain_misfit(CLIP, name):
            dimension = cls(checkpoint, 0).encode_text(["object"]).shape[-1]
            pictures = cls(checkpoint, 0).encode_crops([np.zeros((8, 8, 3), np.uint8)]).shape[-1]
        if dimension != pictures:
            raise EncoderError(
                f"The checkpoint {name} gives words {dimension} numbers and pictures {pictures}. A {CLIP.name} "
                "checkpoint puts both into one space: give another one with --embed.clip"
            )
        return cls(checkpoint, dimension, {} if words is None else Library.of(words, checkpoint.identity))

    @property
    def identity(self) -> str:
        return self.checkpoint.identity

    @torch.inference_mode()
    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """(P, D) unit float32.

        Raises:
            VocabularyError: a prompt is empty, or longer than the model can take.
        """
        model, words = self.checkpoint.model, self.checkpoint.words
        limit = model.config.text_config.max_position_embeddings
        vectors = [torch.zeros(0, self.dimension)]
        for prompt in prompts:
            sentence = _sentence(prompt)
            if sentence not in self._read:  # one at a time, so that the bits of a word do not depend on other words
                length = len(words(sentence)["input_ids"])
                if length > limit:
                    raise VocabularyError(
                        f"The prompt '{prompt[:40]}…' is {length} tokens long and the encoder reads {limit}. "
                        "Say it shorter"
                    )
                # SigLIP was trained on texts of full length; CLIP ignores what follows the end of a text.
                tokens = words([sentence], padding="max_length", max_length=limit, return_tensors="pt")
                self._read[sentence] = _unit(model.get_text_features(tokens["input_ids"].to(model.device)))
            vectors.append(self._read[sentence])
        return torch.cat(vectors[1:] if len(prompts) else vectors)

    @torch.inference_mode()
    def encode_crops(self, crops: Sequence[NDArray[np.uint8]]) -> Tensor:
        """Pictures (h, w, 3) sRGB, square so that nothing is cropped → (M, D) unit float32."""
        model = self.checkpoint.model
        vectors = [torch.zeros(0, self.dimension)]
        for start in range(0, len(crops), BATCH):
            shown = self.checkpoint.pictures(images=list(crops[start : start + BATCH]), return_tensors="pt")
            vectors.append(_unit(model.get_image_features(shown["pixel_values"].to(model.device, model.dtype))))
        return torch.cat(vectors[1:] if len(crops) else vectors)

    def questions(self, prompt: str) -> Sequence[Question | TaughtQuestion]:
        """One question: is it what was taught; for other words, is it this rather than any of the negatives."""
        if name := find_taught_name(prompt, self.taught):
            return [TaughtQuestion(self.taught[name], [])]
        text = _normalise(prompt)
        against = [word for word, plural in NEGATIVES.items() if text not in (word, plural)]
        positive, negatives = self.encode_text([prompt]), self.encode_text(against)
        return [Question(positive, negatives, "cosine", TEMPERATURE, 0.0)]

    def kinds(self) -> Tensor:
        """None: the cosines of these models are not probabilities."""
        return torch.zeros(0, self.dimension)

    def meaning(self, prompt: str) -> str:
        return find_taught_name(prompt, self.taught) or _normalise(prompt)

    def with_words(self, taught: Mapping[str, TaughtWord]) -> ClipEncoder:
        return replace(self, taught=taught)

    def label(self, prompt: str) -> str:
        """As in the built-in vocabulary; unchanged if only CLIP knows the word."""
        try:
            return parse(prompt, self.taught).text
        except VocabularyError:
            return " ".join(prompt.casefold().split())

    def separates(self, one: str, other: str) -> bool:
        return False

    def excludes(self, prompt: str, negative: str) -> bool:
        return self.meaning(prompt) == self.meaning(negative)


def _normalise(prompt: str) -> str:
    """Normalise a prompt: lower case, single spaces, no article.

    Raises:
        VocabularyError: nothing is left.
    """
    words = prompt.casefold().split()
    while words and words[0] in ("a", "an", "the"):
        words = words[1:]
    if not words:
        raise VocabularyError(f"The prompt '{prompt}' holds no word. Say what to count, for example apple")
    return " ".join(words)


def _sentence(prompt: str) -> str:
    words = _normalise(prompt)
    return TEMPLATE.format(article="an" if words[0] in "aeiou" else "a", words=words)


def _unit(output: Any) -> Tensor:
    """(M, D) unit float32 on the CPU of the model's output."""
    return functional.normalize(output.pooler_output.float(), dim=-1).cpu()
