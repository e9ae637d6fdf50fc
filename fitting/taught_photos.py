"""Words that are taught by boxes in photos, and how well they match other photos of the set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score

from ..engine.language.encoders.embedded import EmbeddedEncoder
from ..engine.language.prompts.relevancy import answer
from ..engine.language.teaching.learning import Background, Examples, learn
from ..engine.language.teaching.lesson import select_evenly
from ..engine.language.teaching.region import MOST, SAMPLE
from ..engine.language.vocabulary import CONCEPTS
from .encoder.pictures import IGNORED, POSITIVE_SHARE, Picture, find_inside
from .encoder.samples import STEP, FloatArray, interpolate


@dataclass(frozen=True)
class TaughtScore:
    """Average precision of the pixels in the middle of boxes against those outside all boxes, in the photos of the set
    that were not taught on. photos, boxes: that were taught on."""

    photos: int
    boxes: int
    taught: float
    built_in: float


def score_taught(
    encoder: EmbeddedEncoder, train: Sequence[Picture], val: Sequence[Picture], *, photos: int = 10, seed: int = 0
) -> dict[str, TaughtScore]:
    """Return scores by set of photos. photos: how many of `train` to teach on, evenly selected among those with
    boxes."""
    scores = {}
    for source in sorted({picture.source for picture in val}):
        own = [picture for picture in train if picture.source == source and picture.boxes]
        shown = [own[place] for place in select_evenly(np.arange(len(own)), photos)]
        weights, bias, boxes = _teach(encoder, shown, np.random.default_rng(seed))
        fruit, taught, built_in = list[NDArray[np.bool_]](), list[FloatArray](), list[FloatArray]()
        for picture in (picture for picture in val if picture.source == source):
            known = np.flatnonzero(picture.labels[::STEP, ::STEP] != IGNORED)
            view = encoder.encode_fruit(picture.pixels)
            features, evidence = (
                interpolate(each, picture.labels.shape, STEP).flatten(0, 1)[known]
                for each in (view.features, view.embedding)
            )
            taught.append(evidence.double().numpy() @ weights + bias)
            built_in.append(answer(features, encoder.questions(source)).double().numpy())
            fruit.append(picture.labels[::STEP, ::STEP].ravel()[known] == CONCEPTS.index(source))
        truth = np.concatenate(fruit)
        scores[source] = TaughtScore(
            photos=len(shown),
            boxes=boxes,
            taught=float(average_precision_score(truth, np.concatenate(taught))),
            built_in=float(average_precision_score(truth, np.concatenate(built_in))),
        )
    return scores


def _teach(
    encoder: EmbeddedEncoder, photos: Sequence[Picture], rng: np.random.Generator
) -> tuple[FloatArray, float, int]:
    """Return weights and bias of the word, as `Lesson` learns it from Gaussians, and the number of boxes."""
    rows, groups, background = list[FloatArray](), list[NDArray[np.int64]](), list[FloatArray]()
    for picture in photos:
        evidence = _compute_evidence(encoder, picture)
        for box in picture.boxes:
            pixels = evidence[find_inside(box, POSITIVE_SHARE, picture.labels.shape)]
            if len(pixels):
                rows.append(pixels[select_evenly(np.arange(len(pixels)), MOST)])
                groups.append(np.full(len(rows[-1]), len(groups)))
        flat = evidence.reshape(-1, evidence.shape[-1])
        background.append(flat[rng.choice(len(flat), SAMPLE // len(photos), replace=False)])
    vectors, scenery = np.concatenate(rows), np.concatenate(background)
    count = len(vectors)
    examples = Examples(vectors, np.ones(count, bool), np.zeros(count), np.concatenate(groups))
    weights, bias = learn(examples, Background(scenery, np.zeros(len(scenery)), np.ones(len(scenery))))
    return weights.double().numpy(), bias, len(groups)


def _compute_evidence(encoder: EmbeddedEncoder, picture: Picture) -> FloatArray:
    """Return (H, W, F): what taught words are learnt from."""
    embedding = encoder.encode_fruit(picture.pixels).embedding
    evidence: FloatArray = interpolate(embedding, picture.labels.shape).double().numpy()
    return evidence
