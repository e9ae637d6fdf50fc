"""How good the encoder is on photos it was not trained on, on pasted fruit and on held-out renders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import average_precision_score, roc_auc_score
from torch import Tensor

from fruitlangs.engine.language.embedded import Calibration, EmbeddedEncoder
from fruitlangs.engine.language.relevancy import answer, margin
from fruitlangs.engine.language.vocabulary import CONCEPTS, FRUITS

from .pasting import Cutout, cut_fruit, paste
from .pictures import NOT_FRUIT, Labels, Picture

FloatArray = NDArray[np.float64]

STEP = 5
"""Every so many pixels, across and down, one is measured."""
CALIBRATION_PIXELS = 300_000
"""About this many answers of photos and as many of renders are calibrated on."""


@dataclass(frozen=True)
class PhotoScore:
    """Pixels of one fruit's photos: fruit (central ellipses) against no fruit (outside all boxes)."""

    auc: float
    average_precision: float


@dataclass(frozen=True)
class RenderScore:
    """A fruit's word on held-out renders: IoU, precision and recall of its pixels at P ≥ 0.5."""

    iou: float
    precision: float
    recall: float


@dataclass(frozen=True)
class Measures:
    """Everything the model card shows, by fruit."""

    photos: dict[str, PhotoScore]
    pasted_word: dict[str, float]
    renders: dict[str, RenderScore]
    calibration_error: float | None

    def document(self) -> dict[str, object]:
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Sample:
    """Every STEP-th pixel of a picture that has a known label: features (M, D) in half precision, labels (M,)."""

    features: Tensor
    labels: Labels
    source: str


def sample(encoder: EmbeddedEncoder, pictures: Sequence[Picture]) -> list[Sample]:
    """Encode each picture once; everything but the pasted words is measured on these pixels."""
    samples = []
    for picture in pictures:
        labels = picture.labels[::STEP, ::STEP]
        known = (labels < len(CONCEPTS)) | (labels == NOT_FRUIT)
        features = encoder.encode_dense(picture.pixels)[::STEP, ::STEP]
        samples.append(Sample(features[torch.from_numpy(known)].half(), labels[known], picture.source))
    return samples


def measure(
    encoder: EmbeddedEncoder, val_photos: Sequence[Picture], photos: Sequence[Sample], renders: Sequence[Sample]
) -> Measures:
    """val_photos with their samples, and the samples of renders the network was not trained on."""
    return Measures(
        photos=photo_scores(encoder, photos),
        pasted_word=pasted_words(encoder, val_photos),
        renders=render_scores(encoder, renders),
        calibration_error=calibration_error(encoder, renders),
    )


def photo_scores(encoder: EmbeddedEncoder, photos: Sequence[Sample]) -> dict[str, PhotoScore]:
    """Ranking of pixels by the probability of "fruit"."""
    scores = {}
    for source in sorted({photo.source for photo in photos}):
        mine = [photo for photo in photos if photo.source == source]
        truth = np.concatenate([photo.labels < len(FRUITS) for photo in mine])
        guess = np.concatenate([_answers(encoder, photo, "fruit") for photo in mine])
        scores[source] = PhotoScore(float(roc_auc_score(truth, guess)), float(average_precision_score(truth, guess)))
    return scores


def _answers(encoder: EmbeddedEncoder, pixels: Sample, word: str) -> FloatArray:
    return answer(pixels.features.float(), encoder.questions(word)).double().numpy()


def pasted_words(encoder: EmbeddedEncoder, photos: Sequence[Picture], *, each: int = 10) -> dict[str, float]:
    """Share of pasted fruit pixels whose likeliest fruit word is right, one set's fruit in the other sets' photos."""
    rng = np.random.default_rng(7)
    shares = {}
    bank = cut_fruit(photos)
    for concept, cutouts in enumerate(bank):
        hosts = [picture for picture in photos if FRUITS[concept] not in {box.label for box in picture.boxes}]
        if not cutouts or not hosts:
            continue
        right = total = 0
        for _ in range(each):
            host = hosts[rng.integers(len(hosts))]
            hit, count = _pasted_hits(encoder, host, [cutouts[i] for i in rng.integers(len(cutouts), size=6)], rng)
            right, total = right + hit, total + count
        shares[FRUITS[concept]] = right / max(total, 1)
    return shares


def _pasted_hits(
    encoder: EmbeddedEncoder, host: Picture, cutouts: Sequence[Cutout], rng: np.random.Generator
) -> tuple[int, int]:
    pixels, labels = host.pixels.copy(), np.full(host.labels.shape, NOT_FRUIT, np.uint8)
    for cutout in cutouts:
        paste(pixels, labels, cutout, max(cutout.labels.shape), rng, occlude=False)
    concept = cutouts[0].concept
    words = encoder.encode_dense(pixels)[..., : len(FRUITS)].argmax(-1).numpy()
    pasted = labels == concept
    return int((words[pasted] == concept).sum()), int(pasted.sum())


def render_scores(encoder: EmbeddedEncoder, renders: Sequence[Sample]) -> dict[str, RenderScore]:
    """Each word is asked of every render, also of those that hold another fruit."""
    scores = {}
    for concept, word in enumerate(FRUITS):
        both = asked = there = 0
        for render in renders:
            chosen, true = _answers(encoder, render, word) >= 0.5, render.labels == concept
            both, asked, there = both + int((chosen & true).sum()), asked + int(chosen.sum()), there + int(true.sum())
        if there:
            scores[word] = RenderScore(both / (asked + there - both), both / max(asked, 1), both / there)
    return scores


def calibrate(encoder: EmbeddedEncoder, photos: Sequence[Sample], renders: Sequence[Sample]) -> Calibration:
    """Temperature and bias by logistic regression of "it is this fruit" on the margin of its word.

    Renders, where every pixel is known, weigh three times as much as photos.
    """
    margins, truths, weights = [], [], []
    for samples, share in ((photos, 0.25), (renders, 0.75)):
        pairs = [pair for each in samples for pair in _margins(encoder, each)]
        if not pairs:
            continue
        m, t = (np.concatenate(column) for column in zip(*pairs, strict=True))
        every = max(1, len(m) // CALIBRATION_PIXELS)
        m, t = m[::every], t[::every]
        margins.append(m)
        truths.append(t)
        weights.append(np.full(len(m), share / len(m)))
    m, t, w = np.concatenate(margins), np.concatenate(truths), np.concatenate(weights)
    fit = LogisticRegression(C=1e6, max_iter=200).fit(np.clip(m, -12, 12)[:, None], t, sample_weight=w * len(w))
    return Calibration(temperature=float(1.0 / fit.coef_[0, 0]), bias=float(-fit.intercept_[0]))


def _margins(encoder: EmbeddedEncoder, pixels: Sample) -> Iterator[tuple[FloatArray, NDArray[np.bool_]]]:
    for concept, word in enumerate(FRUITS):
        (question,) = encoder.questions(word)
        yield margin(pixels.features.float(), question).double().numpy(), pixels.labels == concept


def calibration_error(encoder: EmbeddedEncoder, renders: Sequence[Sample], *, bins: int = 10) -> float | None:
    """Expected calibration error of the fruit words on pixels with P ≥ 0.05."""
    if not renders:
        return None
    p = np.concatenate([_answers(encoder, render, word) for render in renders for word in FRUITS])
    t = np.concatenate([render.labels == concept for render in renders for concept in range(len(FRUITS))])
    p, t = p[p >= 0.05], t[p >= 0.05]
    slot = np.minimum((p * bins).astype(int), bins - 1)
    filled = [slot == b for b in range(bins) if (slot == b).any()]
    return float(sum(abs(p[mine].mean() - t[mine].mean()) * mine.mean() for mine in filled))
