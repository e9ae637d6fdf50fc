"""Accuracy of the encoder on photos that were not used for training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics import average_precision_score, roc_auc_score

from ...engine.language.encoders.embedded import EmbeddedEncoder
from ...engine.language.vocabulary import FRUITS
from .pasting import Cutout, cut_fruit, paste
from .pictures import NOT_FRUIT, Picture
from .samples import FloatArray, Sample, answers, interpolate


@dataclass(frozen=True)
class Ranking:
    """Of pixels by a score: area under the ROC curve, and average precision."""

    auc: float
    average_precision: float


@dataclass(frozen=True)
class PhotoScore:
    """Pixels of the photos of one fruit, ranked by P("fruit").

    ellipses: central ellipses of boxes against everything outside all boxes; seen: the same without fruit that has no
    box (`pictures.UNBOXED`); boxes: everything in boxes against everything outside; redness: ellipses ranked by red
    minus green, a baseline for any encoder.
    """

    ellipses: Ranking
    seen: Ranking
    boxes: Ranking
    redness: Ranking


def score_photos(encoder: EmbeddedEncoder, photos: Sequence[Sample]) -> dict[str, PhotoScore]:
    """Return scores by set of photos."""
    scores = {}
    for source in sorted({photo.source for photo in photos}):
        mine = [photo for photo in photos if photo.source == source]
        fruit, known, boxed, missed = (
            np.concatenate([getattr(photo, name) for photo in mine]) for name in ("fruit", "known", "boxed", "missed")
        )
        guess = np.concatenate([answers(encoder, photo, "fruit") for photo in mine])
        colours = np.concatenate([photo.colours for photo in mine])
        seen = known & (fruit | ~missed)
        scores[source] = PhotoScore(
            ellipses=_rank(fruit[known], guess[known]),
            seen=_rank(fruit[seen], guess[seen]),
            boxes=_rank(boxed, guess),
            redness=_rank(fruit[known], (colours[:, 0] - colours[:, 1])[known]),
        )
    return scores


def _rank(truth: NDArray[np.bool_], guess: FloatArray) -> Ranking:
    return Ranking(float(roc_auc_score(truth, guess)), float(average_precision_score(truth, guess)))


def score_pasted_words(encoder: EmbeddedEncoder, photos: Sequence[Picture], *, each: int = 40) -> dict[str, float]:
    """Measure the share of pasted fruit pixels whose most probable fruit word is correct, fruit of one set in photos of
    the others.

    each: photos per set, with six pasted fruit each; with ten photos the share varies by .2 from run to run.
    """
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
            hit, count = _count_pasted_hits(
                encoder, host, [cutouts[i] for i in rng.integers(len(cutouts), size=6)], rng
            )
            right, total = right + hit, total + count
        shares[FRUITS[concept]] = right / max(total, 1)
    return shares


def _count_pasted_hits(
    encoder: EmbeddedEncoder, host: Picture, cutouts: Sequence[Cutout], rng: np.random.Generator
) -> tuple[int, int]:
    pixels, labels = host.pixels.copy(), np.full(host.labels.shape, NOT_FRUIT, np.uint8)
    for cutout in cutouts:
        paste(pixels, labels, cutout, max(cutout.labels.shape), rng, occlude=False)
    concept = cutouts[0].concept
    words = interpolate(encoder.encode_dense(pixels)[..., : len(FRUITS)], labels.shape).argmax(-1).numpy()
    pasted = labels == concept
    return int((words[pasted] == concept).sum()), int(pasted.sum())
