"""The encoder that comes with the package: a small dense network and a fixed vocabulary.

A feature has two blocks of unit length, joined with weights √½: the square roots of the probabilities of the concepts,
and the square roots of the shares of the colour words. A text vector is a basis vector of its block, so the squared
cosine of a pixel with "apple", over the sum of squares in the block, is the network's probability of apple. Square
roots stay useful after averaging over views: the mean of unit vectors still points to what most views agree on.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ...errors import EncoderError
from ...storage.files import halve_precision, read_tensors, write_tensors
from ..colours import cielab, colour_words
from ..taught.library import Library
from ..taught.word import TaughtWord
from ..vocabulary import ANY_FRUIT, COLOURS, CONCEPTS, FRUIT_COLOURS, FRUITS, SURROUNDINGS, Phrase, parse
from .encoder import ColourSplit, FruitView, Question, TaughtQuestion
from .network import Network
from .offsets import OffsetNetwork, load_offsets, offsets_identity
from .seen import Scales, Seen, Skimmed, map_size, resize, scales_of, see

WEIGHTS = Path(__file__).resolve().parent / "weights" / "embedded.safetensors"
FORMAT = "fruitlangs-embedded-2"
LAB, LAB_UNIT = 3, 20.0
"""Numbers of a colour in the embedding, and their unit."""
SKIMMED, MAY_BE_FRUIT = 2_500_000, 0.05
"""Pixels of an image above which it is processed at half its size first, and the probability of fruit there from which
a pixel may be fruit. In photos of a plum tree, with plums 28 pixels wide at full size, a quarter of the pixels have
this probability, and .99 of the pixels of fruit are among them or close to them."""
COLOUR_BLUR = 2
"""Colours are averaged over (2·this + 1)² pixels before they are named."""


@dataclass(frozen=True)
class Calibration:
    """Fitted on held-out renders and photos: temperature and bias of "is it fruit", temperature of "which kind"."""

    temperature: float = 1.0
    bias: float = 0.0
    kind_temperature: float = 1.0


@dataclass(frozen=True, eq=False)
class EmbeddedEncoder:
    """See the module docstring. `network` is fused and in evaluation mode; `taught` are words by name."""

    network: Network
    calibration: Calibration
    identity: str
    taught: Mapping[str, TaughtWord] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path = WEIGHTS, words: Path | None = None) -> EmbeddedEncoder:
        """Read weights written by `save_weights`. words: folder of taught words.

        Raises:
            EncoderError: the weights are missing, damaged, or made for other words.
        """
        stored = read_weights(path)
        if stored.concepts != CONCEPTS:
            raise EncoderError(
                f"The encoder's weights {path} were made for another vocabulary. Train them again with "
                "scripts/developer/train_encoder.py"
            )
        network = stored.network()
        calibration = stored.calibration
        identity = f"embedded-{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
        taught = {} if words is None else Library.of(words, identity)
        return cls(network.fuse(), calibration, identity, taught)

    @property
    def dimension(self) -> int:
        return len(CONCEPTS) + len(COLOURS)

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """(P, D) unit vectors: the sum of the words' vectors, normalised. A taught word that is not built in has none:
        zeros, or the vector of its colours."""
        vectors = torch.zeros(len(prompts), self.dimension)
        for row, phrase in enumerate(map(self.parse, prompts)):
            vectors[row] = sum(
                (functional.normalize(_basis(words, block).sum(0), dim=0) for words, block in _parts(phrase)),
                start=torch.zeros(self.dimension),
            )
        return functional.normalize(vectors, dim=-1)

    @torch.inference_mode()
    def encode_dense(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> Tensor:
        """(H, W, 3) sRGB → (H', W', D), of the size that `map_size` gives."""
        pixels = _pixels(image)
        return _features(self.concept_logits(pixels, scales), pixels)

    @property
    def fruit_identity(self) -> str:
        return f"{self.identity}+{offsets_identity()}"

    @property
    def embedding_size(self) -> int:
        return self.network.head.in_channels + LAB

    @torch.inference_mode()
    def encode_fruit(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> FruitView:
        """Offsets: see `OffsetNetwork`. Embedding: the last features of the network before its logits, and the colour
        in CIELAB, in units of LAB_UNIT: of what was tried, the least numbers from which taught words are learnt best.
        """
        pixels = _pixels(image)
        logits, details, offsets = self._average_scales(pixels, scales, load_offsets(self.identity))
        assert offsets is not None
        lab = cielab(_blur(pixels, logits).permute(1, 2, 0)) / LAB_UNIT
        embedding = torch.cat([details.permute(1, 2, 0), lab], dim=-1)
        return FruitView(_features(logits, pixels), offsets.permute(1, 2, 0), embedding)

    def scales_of(self, height: int, width: int, fruit: float | None = None) -> Scales:
        return scales_of(height, width, fruit)

    @torch.inference_mode()
    def concept_logits(self, pixels: Tensor, scales: Sequence[float] = ()) -> Tensor:
        """(3, H, W) in [0, 1] → (K, H', W'), see `map_size`: the logits of the network, averaged over the scales."""
        return self._average_scales(pixels, scales, None)[0]

    def _average_scales(
        self, pixels: Tensor, scales: Sequence[float], network: OffsetNetwork | None
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return (K, H', W') logits and (C, H', W') the last features before them, averaged over the scales; if there
        is a network for them, (2, H', W') offsets of the scales, by their errors.

        The logits are linear in these features, so interpolating the features is enough.
        """
        _, height, width = pixels.shape
        used = scales or scales_of(height, width)
        size = map_size(height, width, used)
        offsets, certainty = torch.zeros(2, *size), torch.full(size, 1e-6)
        details = torch.zeros(self.network.head.in_channels, *size)
        for seen in self._process_scales(pixels, used, network):
            details += resize(seen.details, *size) / len(used)
            if seen.offsets is not None:
                *off, error = resize(seen.offsets, *size)
                weight = torch.exp(-2.0 * error)
                offsets += torch.stack(off) * weight
                certainty += weight
        logits = self.network.head(details[None])[0]
        return logits, details, None if network is None else offsets / certainty

    def _process_scales(self, pixels: Tensor, scales: Sequence[float], network: OffsetNetwork | None) -> Iterator[Seen]:
        """Compute the outputs at each scale. A large image is processed at half its size first, and then only around
        what may be fruit there."""
        for scale in scales:
            large = pixels[0].numel() * scale**2 > SKIMMED
            skimmed = self._skim(pixels, scale / 2.0, network) if large else None
            yield see(self.network, pixels, scale, network, skimmed)

    def _skim(self, pixels: Tensor, scale: float, network: OffsetNetwork | None) -> Skimmed:
        """Compute the outputs at a scale, with the pixels that may be fruit."""
        seen = see(self.network, pixels, scale, network)
        shares = self.network.head(seen.details[None])[0].softmax(0)
        return Skimmed(seen, shares[[CONCEPTS.index(word) for word in FRUITS]].sum(0) >= MAY_BE_FRUIT)

    def parse(self, prompt: str) -> Phrase:
        """The prompt in the words of the vocabulary and in those that were taught.

        Raises:
            VocabularyError: an unknown word, no word, or more than one noun.
        """
        return parse(prompt, self.taught)

    def questions(self, prompt: str) -> Sequence[Question | TaughtQuestion]:
        """For a fruit: is it fruit rather than surroundings, and is it this kind rather than another.

        For another concept: is it this rather than any other. For a taught word: is it this; it corrects the answers of
        a built-in word of the same name. For a colour: is it this rather than another; for fruit, only among colours
        that fruit have.
        """
        phrase, fit = self.parse(prompt), self.calibration
        asked: list[Question | TaughtQuestion] = []
        known = [] if phrase.noun in self.taught and phrase.noun not in CONCEPTS else phrase.concepts
        if known and set(known) <= set(FRUITS):
            asked.append(_question(FRUITS, SURROUNDINGS, CONCEPTS, fit.temperature, fit.bias))
            if known != FRUITS:
                asked.append(_question(known, FRUITS, CONCEPTS, fit.kind_temperature))
        elif known:
            asked.append(_question(known, CONCEPTS, CONCEPTS))
        if phrase.noun in self.taught:
            prior = [question for question in asked if isinstance(question, Question)]
            asked = [TaughtQuestion(self.taught[phrase.noun], prior)]
        if phrase.colours:
            of_fruit = self._all_fruit(phrase) and set(phrase.colours) <= set(FRUIT_COLOURS)
            asked.append(_question(phrase.colours, FRUIT_COLOURS if of_fruit else COLOURS, COLOURS))
        return asked

    def _all_fruit(self, phrase: Phrase) -> bool:
        """Whether a phrase names fruit only; taught words that are not built in count as fruit."""
        return bool(phrase.concepts) and all(
            word in FRUITS or (word in self.taught and word not in CONCEPTS) for word in phrase.concepts
        )

    def kinds(self) -> Tensor:
        return _basis(FRUITS, CONCEPTS)

    @property
    def kind_words(self) -> Sequence[str]:
        return FRUITS

    def of_any_kind(self, prompt: str) -> str | None:
        phrase = self.parse(prompt)
        if not self._all_fruit(phrase) or set(phrase.concepts) >= set(FRUITS):
            return None
        return phrase.text.removesuffix(phrase.noun) + ANY_FRUIT

    def split_colours(self, prompts: Sequence[str], negatives: Sequence[str]) -> ColourSplit | None:
        """See `ColourEncoder`. All prompts must name the same fruit; a negative chooses if it is as general."""
        sought, unwanted = [list(map(self.parse, phrases)) for phrases in (prompts, negatives)]
        fruit = sought[0].concepts
        if not self._all_fruit(sought[0]) or any(phrase.concepts != fruit for phrase in sought):
            return None
        choosing = [
            phrase.colours and (not phrase.concepts or set(fruit) <= set(phrase.concepts)) for phrase in unwanted
        ]
        barred = {
            colour for phrase, chooses in zip(unwanted, choosing, strict=True) if chooses for colour in phrase.colours
        }
        named = {colour for phrase in sought for colour in phrase.colours} | barred
        if not named:
            return None
        words = FRUIT_COLOURS if named <= set(FRUIT_COLOURS) else COLOURS
        asked = {colour for phrase in sought for colour in phrase.colours or words} - barred
        return ColourSplit(
            prompts=(sought[0].noun,),
            negatives=[text for text, chooses in zip(negatives, choosing, strict=True) if not chooses],
            kinds=fruit,
            words=words,
            asked=[word in asked for word in words],
        )

    def meaning(self, prompt: str) -> str:
        phrase = self.parse(prompt)
        return " ".join([*sorted(phrase.colours), "|", *sorted(phrase.concepts)])

    def with_words(self, taught: Mapping[str, TaughtWord]) -> EmbeddedEncoder:
        return replace(self, taught=taught)

    def label(self, prompt: str) -> str:
        return self.parse(prompt).text

    def separates(self, one: str, other: str) -> bool:
        return self.parse(one).excludes(self.parse(other))

    def excludes(self, prompt: str, negative: str) -> bool:
        return self.parse(prompt).within(self.parse(negative))


@dataclass(frozen=True, eq=False)
class StoredWeights:
    """The content that `save_weights` wrote. notes: other entries of the header."""

    concepts: tuple[str, ...]
    widths: tuple[int, ...]
    depths: tuple[int, ...]
    calibration: Calibration
    tensors: Mapping[str, Tensor]
    notes: Mapping[str, Any]

    def network(self) -> Network:
        """The network with these weights, not fused."""
        network = Network(len(self.concepts), widths=self.widths, depths=self.depths)
        network.load_state_dict(dict(self.tensors))
        return network


def read_weights(path: Path) -> StoredWeights:
    """Read weights written by `save_weights`, of any vocabulary.

    Raises:
        EncoderError: it is missing or damaged.
    """
    if not path.is_file():
        raise EncoderError(f"The encoder's weights {path} are missing. Install the package again")
    try:
        tensors, header = read_tensors(path)
        if header["format"] != FORMAT:
            raise ValueError(f"format {header['format']}")
        stored = StoredWeights(
            tuple(header["concepts"]),
            tuple(header["widths"]),
            tuple(header["depths"]),
            Calibration(**header["calibration"]),
            {name: tensor.float() for name, tensor in tensors.items()},
            header,
        )
        stored.network()
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise EncoderError(
            f"The encoder's weights {path} cannot be read ({str(error).splitlines()[0]}). Install the package again"
        ) from error
    return stored


def save_weights(
    path: Path,
    network: Network,
    calibration: Calibration,
    *,
    widths: Sequence[int],
    depths: Sequence[int],
    **notes: object,
) -> None:
    """Write an unfused network in half precision, with everything needed to open it and `notes` in the header."""
    header = {
        "format": FORMAT,
        "concepts": list(CONCEPTS),
        "widths": list(widths),
        "depths": list(depths),
        "calibration": asdict(calibration),
        **notes,
    }
    write_tensors(path, halve_precision(network.state_dict()), header)


def _parts(phrase: Phrase) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
    """The words of a phrase with the block of each."""
    concepts = tuple(word for word in phrase.concepts if word in CONCEPTS)
    pairs = [(concepts, CONCEPTS), (phrase.colours, COLOURS)]
    return [(words, block) for words, block in pairs if words]


def _question(
    words: Sequence[str], against: Sequence[str], block: tuple[str, ...], temperature: float = 1.0, bias: float = 0.0
) -> Question:
    others = [word for word in against if word not in words]
    return Question(_basis(words, block), _basis(others, block), "posterior", temperature, bias)


def _basis(words: Sequence[str], block: tuple[str, ...]) -> Tensor:
    """(len(words), D) one basis vector a word."""
    offset = 0 if block is CONCEPTS else len(CONCEPTS)
    vectors = torch.zeros(len(words), len(CONCEPTS) + len(COLOURS))
    for row, word in enumerate(words):
        vectors[row, offset + block.index(word)] = 1.0
    return vectors


def _pixels(image: NDArray[np.uint8]) -> Tensor:
    """(H, W, 3) sRGB → (3, H, W) in [0, 1]."""
    return torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255.0


def _features(logits: Tensor, pixels: Tensor) -> Tensor:
    """(H', W', D) from the logits (K, H', W') of the concepts and the pixels (3, H, W) of the photo."""
    colours = colour_words(_blur(pixels, logits).permute(1, 2, 0))
    return torch.cat([logits.softmax(0).permute(1, 2, 0), colours], dim=-1).mul_(0.5).sqrt_()


def _blur(pixels: Tensor, logits: Tensor) -> Tensor:
    """Average (3, H, W) over neighbours → (3, H', W') of the logits' size."""
    kernel = 2 * COLOUR_BLUR + 1
    padded = functional.pad(resize(pixels, *logits.shape[-2:])[None], [COLOUR_BLUR] * 4, mode="replicate")
    return functional.avg_pool2d(padded, kernel, stride=1)[0]
