"""How good the encoder is on photos it was not trained on, on pasted fruit and on held-out renders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import average_precision_score, roc_auc_score
from torch import Tensor
from torch.nn import functional

from fruitlangs.engine.language.embedded import Calibration, EmbeddedEncoder
from fruitlangs.engine.language.prior import in_scene
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
    fruit_iou: float | None
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
        fruit_iou=fruit_iou(encoder, renders),
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
    """Each word is asked of every scene, also of those with another fruit, given the scene's shares of kinds."""
    scenes = [_weighed(encoder, [each for each in renders if each.source == name]) for name in _sources(renders)]
    scores = {}
    for concept, word in enumerate(FRUITS):
        both = asked = there = 0
        for scene in scenes:
            chosen, true = _answers(encoder, scene, word) >= 0.5, scene.labels == concept
            both, asked, there = both + int((chosen & true).sum()), asked + int(chosen.sum()), there + int(true.sum())
        if there:
            scores[word] = RenderScore(both / (asked + there - both), both / max(asked, 1), both / there)
    return scores


def _sources(samples: Sequence[Sample]) -> list[str]:
    return sorted({each.source for each in samples})


def _weighed(encoder: EmbeddedEncoder, samples: Sequence[Sample]) -> Sample:
    """All pixels of one scene, their kinds of fruit weighed as `relevancy` does it."""
    features = torch.cat([each.features for each in samples]).float()
    weights = torch.full((len(features),), float(STEP * STEP))
    features = in_scene(features, weights, encoder.kinds()).half()
    return Sample(features, np.concatenate([each.labels for each in samples]), samples[0].source)


def fruit_iou(encoder: EmbeddedEncoder, renders: Sequence[Sample]) -> float | None:
    """Intersection over union of the word "fruit" at P ≥ 0.5."""
    if not renders:
        return None
    chosen = np.concatenate([_answers(encoder, render, "fruit") >= 0.5 for render in renders])
    true = np.concatenate([render.labels < len(FRUITS) for render in renders])
    return float((chosen & true).sum() / max((chosen | true).sum(), 1))


def calibrate(encoder: EmbeddedEncoder, photos: Sequence[Sample], renders: Sequence[Sample]) -> Calibration:
    """Logistic regression of "it is fruit" on the margin of "fruit", and the temperature at which kinds are likeliest.

    Renders, where every pixel is known, weigh three times as much as photos.
    """
    margins, truths, weights = [], [], []
    (question,) = encoder.questions("fruit")
    for samples, share in ((photos, 0.25), (renders, 0.75)):
        if not samples:
            continue
        m = np.concatenate([margin(each.features.float(), question).double().numpy() for each in samples])
        t = np.concatenate([each.labels < len(FRUITS) for each in samples])
        every = max(1, len(m) // CALIBRATION_PIXELS)
        margins.append(m[::every])
        truths.append(t[::every])
        weights.append(np.full(len(margins[-1]), share / len(margins[-1])))
    m, t, w = np.concatenate(margins), np.concatenate(truths), np.concatenate(weights)
    fit = LogisticRegression(C=1e6, max_iter=200).fit(np.clip(m, -12, 12)[:, None], t, sample_weight=w * len(w))
    return Calibration(
        temperature=float(1.0 / fit.coef_[0, 0]),
        bias=float(-fit.intercept_[0]),
        kind_temperature=_kind_temperature(encoder, [*photos, *renders]),
    )


def _kind_temperature(encoder: EmbeddedEncoder, samples: Sequence[Sample]) -> float:
    """The temperature of the kinds' logits that makes the true kinds of fruit pixels likeliest."""
    logits, labels = [], []
    for each in samples:
        mine = torch.from_numpy(each.labels < len(FRUITS))
        logits.append(2.0 * (each.features[mine].float() @ encoder.kinds().T).clamp_min(1e-6).log())
        labels.append(torch.from_numpy(each.labels)[mine].long())
    z, k = torch.cat(logits), torch.cat(labels)
    temperatures = np.geomspace(0.5, 4.0, 31)
    losses = [float(functional.cross_entropy(z / float(t), k)) for t in temperatures]
    return float(temperatures[int(np.argmin(losses))])


def calibration_error(encoder: EmbeddedEncoder, renders: Sequence[Sample], *, bins: int = 10) -> float | None:
    """Expected calibration error of "fruit" on pixels with P ≥ 0.05."""
    if not renders:
        return None
    p = np.concatenate([_answers(encoder, render, "fruit") for render in renders])
    t = np.concatenate([render.labels < len(FRUITS) for render in renders])
    p, t = p[p >= 0.05], t[p >= 0.05]
    slot = np.minimum((p * bins).astype(int), bins - 1)
    filled = [slot == b for b in range(bins) if (slot == b).any()]
    return float(sum(abs(p[mine].mean() - t[mine].mean()) * mine.mean() for mine in filled))
