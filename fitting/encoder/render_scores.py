"""Accuracy of the encoder on renders that were not used for training, by kind of fruit and by difficulty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image, ImageFilter

from ...engine.language.encoders.embedded import EmbeddedEncoder
from ...engine.language.vocabulary import CONCEPTS, FRUITS
from .pasting import Cutout, cut_fruit, paste
from .pictures import Picture
from .samples import Sample, answers_in_scene, join_by_scene, sample

BLUR = 1.5
"""Standard deviation in pixels of the blur that the condition "blurred" adds."""
GUESTS = 5
"""Fruit of other kinds that the condition "mixed" pastes into each picture."""


@dataclass(frozen=True)
class RenderScore:
    """A word on held-out renders: IoU, precision and recall of its pixels at P ≥ 0.5."""

    iou: float
    precision: float
    recall: float


@dataclass(frozen=True)
class Condition:
    """IoU under a difficult condition: of the word "fruit", and of the kinds' own words over all kinds together."""

    pictures: int
    fruit_iou: float
    kind_iou: float


class _Tally:
    """Counts of predicted pixels, true pixels, and both."""

    def __init__(self) -> None:
        self.both = self.asked = self.there = 0

    def add(self, encoder: EmbeddedEncoder, scene: Sample, word: str) -> None:
        chosen = answers_in_scene(encoder, scene, word) >= 0.5
        true = scene.fruit if word == "fruit" else scene.labels == CONCEPTS.index(word)
        self.both += int((chosen & true).sum())
        self.asked += int(chosen.sum())
        self.there += int(true.sum())

    @property
    def iou(self) -> float:
        return self.both / max(self.asked + self.there - self.both, 1)

    @property
    def score(self) -> RenderScore:
        return RenderScore(self.iou, self.both / max(self.asked, 1), self.both / max(self.there, 1))


def score_renders(encoder: EmbeddedEncoder, renders: Sequence[Sample]) -> dict[str, RenderScore]:
    """Each word is applied to every scene, also to those with another fruit, with the scene's shares of kinds."""
    scenes = join_by_scene(renders)
    scores = {}
    for word in ("fruit", *FRUITS):
        tally = _Tally()
        for scene in scenes:
            tally.add(encoder, scene, word)
        if tally.there:
            scores[word] = tally.score
    return scores


def score_conditions(
    encoder: EmbeddedEncoder, pictures: Sequence[Picture], samples: Sequence[Sample]
) -> dict[str, Condition]:
    """Return scores by condition: traits of scenes, a blur, and fruit of other kinds pasted into each picture.

    samples: of `pictures`, one by one.
    """
    pairs = list(zip(pictures, samples, strict=True))
    traits = sorted({trait for picture in pictures for trait in picture.traits})
    chosen = {trait: [each for picture, each in pairs if trait in picture.traits] for trait in traits}
    if pictures:
        rng = np.random.default_rng(11)
        bank = cut_fruit(pictures)
        chosen["blurred"] = sample(encoder, [_blur(picture) for picture in pictures])
        chosen["mixed species"] = sample(encoder, [_mix(picture, bank, rng) for picture in pictures])
    return {name: _score_condition(encoder, mine) for name, mine in chosen.items()}


def _score_condition(encoder: EmbeddedEncoder, samples: Sequence[Sample]) -> Condition:
    fruit, kinds = _Tally(), _Tally()
    for scene in join_by_scene(samples):
        fruit.add(encoder, scene, "fruit")
        for concept in np.unique(scene.labels[scene.fruit]):
            kinds.add(encoder, scene, FRUITS[concept])
    return Condition(len(samples), fruit.iou, kinds.iou)


def _blur(picture: Picture) -> Picture:
    return replace(picture, pixels=np.asarray(Image.fromarray(picture.pixels).filter(ImageFilter.GaussianBlur(BLUR))))


def _mix(picture: Picture, bank: Sequence[Sequence[Cutout]], rng: np.random.Generator) -> Picture:
    own = set(np.unique(picture.labels).tolist())
    kinds = [cutouts for concept, cutouts in enumerate(bank) if cutouts and concept not in own]
    pixels, labels = picture.pixels.copy(), picture.labels.copy()
    for _ in range(GUESTS if kinds else 0):
        cutouts = kinds[rng.integers(len(kinds))]
        cutout = cutouts[rng.integers(len(cutouts))]
        paste(pixels, labels, cutout, max(cutout.labels.shape), rng)
    return replace(picture, pixels=pixels, labels=labels)
