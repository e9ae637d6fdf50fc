"""The encoder that comes with the package: a small dense network and a fixed vocabulary.

A feature has two blocks of unit length, joined with weights √½: the square roots of the probabilities of the concepts,
and the square roots of the shares of the colour words. A text vector is a basis vector of its block, so the squared
cosine of a pixel with "apple", over the sum of squares in the block, is the network's probability of apple. Square
roots stay useful after averaging over views: the mean of unit vectors still points to what most views agree on.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from ...errors import EncoderError
from ...storage.files import halved, read_tensors, write_tensors
from ..colours import colour_words
from ..vocabulary import COLOURS, CONCEPTS, FRUIT_COLOURS, FRUITS, SURROUNDINGS, Phrase, parse
from .encoder import ColourSplit, Question
from .network import Network, at_pixels, levels_at, resized
from .offsets import OffsetNetwork, stored_offsets

WEIGHTS = Path(__file__).resolve().parent / "weights" / "embedded.safetensors"
FORMAT = "fruitlangs-embedded-2"
SEEN_SIDE = 960
"""Longest side of a photo in the network, pixels; small photos are enlarged, at most twice."""
MAX_SIDE = 1600
"""Longest side of the features; larger photos are scaled down first."""
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
    """See the module docstring. `network` is fused and in evaluation mode."""

    network: Network
    calibration: Calibration
    identity: str

    @classmethod
    def open(cls, path: Path = WEIGHTS) -> EmbeddedEncoder:
        """Read weights written by `save_weights`.

        Raises:
            EncoderError: they are missing, damaged, or made for other words.
        """
        stored = read_weights(path)
        if stored.concepts != CONCEPTS:
            raise EncoderError(
                f"The encoder's weights {path} were made for another vocabulary. Train them again with "
                "scripts/train_encoder.py"
            )
        network = stored.network()
        calibration = stored.calibration
        fingerprint = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        return cls(network.fuse(), calibration, f"embedded-{fingerprint}")

    @property
    def dimension(self) -> int:
        return len(CONCEPTS) + len(COLOURS)

    def encode_text(self, prompts: Sequence[str]) -> Tensor:
        """(P, D) unit vectors: the sum of the words' vectors, normalised."""
        vectors = torch.zeros(len(prompts), self.dimension)
        for row, phrase in enumerate(map(parse, prompts)):
            vectors[row] = sum(
                (functional.normalize(_basis(words, block).sum(0), dim=0) for words, block in _parts(phrase)),
                start=torch.zeros(self.dimension),
            )
        return functional.normalize(vectors, dim=-1)

    @torch.inference_mode()
    def encode_dense(self, image: NDArray[np.uint8]) -> Tensor:
        """(H, W, 3) sRGB → (H', W', D), of the photo's size unless its longer side is above MAX_SIDE."""
        pixels = _pixels(image)
        return _features(self.concept_logits(pixels), pixels)

    @torch.inference_mode()
    def encode_fruit(self, image: NDArray[np.uint8]) -> tuple[Tensor, Tensor]:
        """The features of `encode_dense`, and (H', W', 2) where on its fruit each pixel lies, see `OffsetNetwork`."""
        pixels = _pixels(image)
        logits, offsets = self._seen(pixels, (), stored_offsets(self.identity))
        assert offsets is not None
        return _features(logits, pixels), offsets.permute(1, 2, 0)

    @torch.inference_mode()
    def concept_logits(self, pixels: Tensor, scales: Sequence[float] = ()) -> Tensor:
        """(3, H, W) in [0, 1] → (K, H, W): the logits of the network, averaged over the scales of the image."""
        return self._seen(pixels, scales, None)[0]

    def _seen(
        self, pixels: Tensor, scales: Sequence[float], network: OffsetNetwork | None
    ) -> tuple[Tensor, Tensor | None]:
        """(K, H, W) logits, and (2, H, W) offsets if there is a network for them: of the scales, by their errors."""
        _, height, width = pixels.shape
        logits = torch.zeros(len(CONCEPTS), height, width)
        offsets, certainty = torch.zeros(2, height, width), torch.full((height, width), 1e-6)
        used = scales or seen_scales(height, width)
        for scale in used:
            size = max(1, round(height * scale)), max(1, round(width * scale))
            levels = levels_at(self.network, pixels, *size)
            logits += _of_size(at_pixels(self.network.named(levels), *size), height, width) / len(used)
            if network is not None:
                *off, error = _of_size(at_pixels(network(levels), *size), height, width)
                weight = torch.exp(-2.0 * error)
                offsets += torch.stack(off) * weight
                certainty += weight
        return logits, None if network is None else offsets / certainty

    def questions(self, prompt: str) -> Sequence[Question]:
        """For a fruit: is it fruit rather than surroundings, and is it this kind rather than another.

        For another concept: is it this rather than any other. For a colour: is it this rather than another; for fruit,
        only among colours that fruit have.
        """
        phrase, fit = parse(prompt), self.calibration
        asked = []
        of_fruit = bool(phrase.concepts) and set(phrase.concepts) <= set(FRUITS)
        if of_fruit:
            asked.append(_question(FRUITS, SURROUNDINGS, CONCEPTS, fit.temperature, fit.bias))
            if phrase.concepts != FRUITS:
                asked.append(_question(phrase.concepts, FRUITS, CONCEPTS, fit.kind_temperature))
        elif phrase.concepts:
            asked.append(_question(phrase.concepts, CONCEPTS, CONCEPTS))
        if phrase.colours:
            against = FRUIT_COLOURS if of_fruit and set(phrase.colours) <= set(FRUIT_COLOURS) else COLOURS
            asked.append(_question(phrase.colours, against, COLOURS))
        return asked

    def kinds(self) -> Tensor:
        return _basis(FRUITS, CONCEPTS)

    def split_colours(self, prompts: Sequence[str], negatives: Sequence[str]) -> ColourSplit | None:
        """See `ColourEncoder`. All prompts must name the same fruit; a negative chooses if it is as general."""
        sought, unwanted = [list(map(parse, phrases)) for phrases in (prompts, negatives)]
        fruit = sought[0].concepts
        if not fruit or not set(fruit) <= set(FRUITS) or any(phrase.concepts != fruit for phrase in sought):
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
            prompts=(sought[0].text.split()[-1],),
            negatives=[text for text, chooses in zip(negatives, choosing, strict=True) if not chooses],
            kinds=fruit,
            words=words,
            asked=[word in asked for word in words],
        )

    def meaning(self, prompt: str) -> str:
        phrase = parse(prompt)
        return " ".join([*sorted(phrase.colours), "|", *sorted(phrase.concepts)])

    def separates(self, one: str, other: str) -> bool:
        return parse(one).excludes(parse(other))

    def excludes(self, prompt: str, negative: str) -> bool:
        return parse(prompt).within(parse(negative))


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


def seen_scales(height: int, width: int) -> tuple[float, ...]:
    """The sizes, relative to the photo, at which the network processes it.

    A photo so small that it is enlarged twice is processed once: its fruit is small. Larger ones are also processed at
    half size, where fruit that fills much of the photo still fits the receptive field.
    """
    fine = SEEN_SIDE / max(height, width)
    return (2.0,) if fine >= 2.0 else (fine, fine / 2.0)


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
    write_tensors(path, halved(network.state_dict()), header)


def _parts(phrase: Phrase) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
    """The words of a phrase with the block of each."""
    pairs = [(phrase.concepts, CONCEPTS), (phrase.colours, COLOURS)]
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
    """(H, W, 3) sRGB → (3, H', W') in [0, 1], with no side above MAX_SIDE."""
    pixels = torch.from_numpy(np.array(image)).permute(2, 0, 1).float() / 255.0
    shrink = min(1.0, MAX_SIDE / max(pixels.shape[-2:]))
    return resized(pixels, shrink) if shrink < 1.0 else pixels


def _features(logits: Tensor, pixels: Tensor) -> Tensor:
    """(H, W, D) from the logits (K, H, W) of the concepts and the colours of the pixels (3, H, W)."""
    colours = colour_words(_blurred(pixels).permute(1, 2, 0))
    return torch.cat([logits.softmax(0).permute(1, 2, 0), colours], dim=-1).mul_(0.5).sqrt_()


def _of_size(values: Tensor, height: int, width: int) -> Tensor:
    """(C, h, w) → (C, height, width), averaged when it shrinks."""
    if values.shape[-2:] == (height, width):
        return values
    return functional.interpolate(values[None], (height, width), mode="bilinear", antialias=True)[0]


def _blurred(pixels: Tensor) -> Tensor:
    kernel = 2 * COLOUR_BLUR + 1
    padded = functional.pad(pixels[None], [COLOUR_BLUR] * 4, mode="replicate")
    return functional.avg_pool2d(padded, kernel, stride=1)[0]
