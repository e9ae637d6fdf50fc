"""Temperatures and bias that calibrate the encoder's probabilities for single pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from torch.nn import functional

from ...engine.language.encoders.embedded import Calibration, EmbeddedEncoder
from ...engine.language.encoders.encoder import Question
from ...engine.language.prompts.relevancy import margin
from .samples import FloatArray, Sample

PIXELS = 300_000
"""Approximate number of answers of photos, and of renders, for calibration."""
WIDEST = 12.0
"""Margins are clipped to this range."""


@dataclass(frozen=True)
class Fit:
    """A calibration and the share of fruit, by weight, among the data of the fit."""

    calibration: Calibration
    prior: float


def calibrate(encoder: EmbeddedEncoder, photos: Sequence[Sample], renders: Sequence[Sample]) -> Fit:
    """Logistic regression of "it is fruit" on the margin of "fruit", and the most likely temperature of the kinds.

    Photos and renders have the same weight.
    """
    margins, truths, weights = [], [], []
    (question,) = encoder.questions("fruit")
    assert isinstance(question, Question)  # no word was taught
    for samples in (photos, renders):
        known = [each.select(each.known & (each.fruit | ~each.missed)) for each in samples]
        if not known:
            continue
        m = np.concatenate([margin(each.features.float(), question).double().numpy() for each in known])
        t = np.concatenate([each.fruit for each in known])
        every = max(1, len(m) // PIXELS)
        margins.append(m[::every])
        truths.append(t[::every])
        weights.append(np.full(len(margins[-1]), 1.0 / len(margins[-1])))
    m, t, w = np.concatenate(margins), np.concatenate(truths), np.concatenate(weights)
    temperature, bias = logistic(m, t, w)
    kind_temperature = _kind_temperature(encoder, [*photos, *renders])
    return Fit(Calibration(temperature, bias, kind_temperature), float((w * t).sum() / w.sum()))


def logistic(margins: FloatArray, truth: NDArray[np.bool_], weights: FloatArray) -> tuple[float, float]:
    """Temperature and bias at which σ(margin / temperature − bias) fits (M,) truths best, by weight."""
    weights = weights * (len(weights) / weights.sum())
    fit = LogisticRegression(C=1e6, max_iter=200).fit(np.clip(margins, -WIDEST, WIDEST)[:, None], truth, weights)
    return float(1.0 / fit.coef_[0, 0]), float(-fit.intercept_[0])


def _kind_temperature(encoder: EmbeddedEncoder, samples: Sequence[Sample]) -> float:
    """The temperature of the kinds' logits with the highest likelihood of the true kinds of fruit pixels."""
    logits, labels = [], []
    for each in samples:
        mine = each.select(each.fruit)
        logits.append(2.0 * (mine.features.float() @ encoder.kinds().T).clamp_min(1e-6).log())
        labels.append(torch.from_numpy(mine.labels).long())
    z, k = torch.cat(logits), torch.cat(labels)
    temperatures = np.geomspace(0.5, 4.0, 31)
    losses = [float(functional.cross_entropy(z / float(t), k)) for t in temperatures]
    return float(temperatures[int(np.argmin(losses))])
