"""Learns a word from examples: a regularised logistic regression, solved by Newton's method.

Everything is in float64 and in a fixed order, so equal examples give equal words.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor

from ...errors import VocabularyError

FloatArray = NDArray[np.float64]

PENALTY = 20.0
"""Weight of the squared weights of standardised evidence, against NEW or REFINED."""
NEW, REFINED = (200.0, 50.0, 20.0), (4000.0, 50.0, 50.0)
"""Weight of all background together, of all positive and of all negative examples: for a new word, and for a built-in
one, whose answers the background keeps."""
ROUNDS = 6
"""The background contains fruit without a click. What the word takes for its fruit is left out of it, and the
word is learnt again, this many times in all."""
LEAST_LIKE = 25.0
"""Percentile of the positive examples' log odds from which the background is left out, if that is below 0: at first,
where much of the background is fruit, even the examples have log odds below 0. Of the negative examples of a refined
word it is the percentile from the other end, if that is above 0."""
LEAST_WRONG = 1e-3
"""Added to how wrong a built-in word is about a Gaussian of an example."""
STEPS, CONVERGED = 30, 1e-9
"""Most Newton steps, and the largest change of a weight after the last."""
LEAST_SPREAD = 1e-3
"""Added to the standard deviation of evidence."""
CONTRADICTION = 0.999
"""Cosine of standardised evidence from which a positive and a negative example are the same."""


@dataclass(frozen=True, eq=False)
class Examples:
    """Evidence of Gaussians. vectors: (n, F); positive: (n,) bool; prior: (n,) log odds of the built-in word that is
    refined, 0 for a new word; groups: (n,) which example each is of: all examples have the same weight."""

    vectors: FloatArray
    positive: NDArray[np.bool_]
    prior: FloatArray
    groups: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Background:
    """Evidence of Gaussians of the scene. vectors: (b, F); prior: (b,) as of `Examples`; weights: (b,) their pixels."""

    vectors: FloatArray
    prior: FloatArray
    weights: FloatArray


def learn(examples: Examples, background: Background) -> tuple[Tensor, float]:
    """The weights (F,) float32 and the bias of a word.

    The background of a new word is negative, except what looks like the positive examples: learning from positive and
    unlabelled examples (Liu et al. 2003, "Building text classifiers using positive and unlabeled examples"). That of a
    built-in word keeps the answers of the word.

    Raises:
        VocabularyError: a new word has no positive example, or a built-in one no example at all.
    """
    refines = bool(background.prior.any())
    if not (examples.positive.any() or (refines and len(examples.positive))):
        raise VocabularyError("A positive example is missing. Click on the fruit that the word names")
    mean, spread = scale_of(background.vectors, background.weights)
    own, rest = ((each.vectors - mean) / spread for each in (examples, background))
    scenery, positive, negative = REFINED if refines else NEW
    around = scenery * background.weights / background.weights.sum()
    weights = np.concatenate([_shares(examples, positive, negative, refines=refines), around])
    vectors = np.concatenate([own, rest])
    prior = np.concatenate([examples.prior, background.prior])
    known = expit(background.prior) if refines else np.zeros(len(rest))
    target = np.concatenate([examples.positive, known])
    solved = logistic(vectors, target, weights, prior)
    for _ in range(ROUNDS - 1):
        odds = vectors @ solved[:-1] + solved[-1] + prior
        said = background.prior if refines else None
        alike = _find_similar(odds[: len(own)], odds[len(own) :], examples.positive, said)
        solved = logistic(vectors, target, weights * np.concatenate([np.ones(len(own)), ~alike]), prior)
    slopes = solved[:-1] / spread
    return torch.from_numpy(slopes.astype(np.float32)), float(solved[-1] - slopes @ mean)


def _find_similar(
    own: FloatArray, rest: FloatArray, positive: NDArray[np.bool_], said: FloatArray | None
) -> NDArray[np.bool_]:
    """Find which of the background (b,) looks like the examples, so that its own answer does not count.

    own, rest: (n,), (b,) log odds of the examples and of the background; positive: (n,); said: (b,) log odds of the
    built-in word that is refined: only what it says the opposite of can look like an example.
    """
    fruit = np.zeros(len(rest), bool)
    if positive.any():
        fruit = rest >= min(0.0, float(np.percentile(own[positive], LEAST_LIKE)))
    if said is None:
        return fruit
    other = np.zeros(len(rest), bool)
    if not positive.all():
        other = rest < max(0.0, float(np.percentile(own[~positive], 100.0 - LEAST_LIKE)))
    return np.where(said < 0.0, fruit, other)


def contradiction(examples: Examples, background: Background) -> tuple[int, int] | None:
    """The groups of a positive and of a negative example whose mean evidence is the same; None if no two are."""
    mean, spread = scale_of(background.vectors, background.weights)
    numbers, first, place = np.unique(examples.groups, return_index=True, return_inverse=True)
    sums = np.zeros((len(numbers), examples.vectors.shape[1]))
    np.add.at(sums, place, (examples.vectors - mean) / spread)
    unit = sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)
    positive = examples.positive[first]
    if positive.all() or not positive.any():
        return None
    for own, number in zip(unit[positive], numbers[positive], strict=True):
        cosines = unit[~positive] @ own
        if cosines.max() > CONTRADICTION:
            return int(number), int(numbers[~positive][cosines.argmax()])
    return None


def logistic(vectors: FloatArray, target: FloatArray, weights: FloatArray, prior: FloatArray) -> FloatArray:
    """(F + 1,) weights and bias of the weighted logistic regression with PENALTY, by damped Newton steps.

    vectors: (n, F); target: (n,) 0 or 1; weights: (n,); prior: (n,) log odds that are added.
    """
    columns = np.concatenate([vectors, np.ones((len(vectors), 1))], axis=1)
    penalty = np.full(columns.shape[1], PENALTY)
    penalty[-1] = 1e-6
    solved = np.zeros(columns.shape[1])
    loss = _loss(columns, target, weights, prior, penalty, solved)
    for _ in range(STEPS):
        chance = 1.0 / (1.0 + np.exp(-np.clip(columns @ solved + prior, -40.0, 40.0)))
        slope = columns.T @ (weights * (chance - target)) + penalty * solved
        curved = (columns * (weights * chance * (1.0 - chance))[:, None]).T @ columns + np.diag(penalty)
        step, size = np.linalg.solve(curved, slope), 1.0
        while size > 1e-4:
            fresh = solved - size * step
            better = _loss(columns, target, weights, prior, penalty, fresh)
            if better <= loss:
                break
            size /= 2.0
        else:
            break
        solved, loss = fresh, better
        if np.abs(size * step).max() < CONVERGED:
            break
    return solved


def _loss(
    columns: FloatArray,
    target: FloatArray,
    weights: FloatArray,
    prior: FloatArray,
    penalty: FloatArray,
    solved: FloatArray,
) -> float:
    odds = columns @ solved + prior
    return float((weights * (np.logaddexp(0.0, odds) - target * odds)).sum() + 0.5 * (penalty * solved**2).sum())


def scale_of(vectors: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(F,) mean and standard deviation of evidence (n, F) with weights (n,)."""
    shares = weights / weights.sum()
    mean: FloatArray = shares @ vectors
    spread: FloatArray = np.sqrt(shares @ (vectors - mean) ** 2) + LEAST_SPREAD
    return mean, spread


def _shares(examples: Examples, positive: float, negative: float, *, refines: bool) -> FloatArray:
    """(n,) weight of each: examples of one sign share its weight, and the Gaussians of an example that of the example:
    equally for a new word, and by how wrong the built-in word is about each if that is refined."""
    weights = np.zeros(len(examples.vectors))
    wrong = np.abs(examples.positive - expit(examples.prior)) + LEAST_WRONG if refines else np.ones(len(weights))
    for sign, total in ((True, positive), (False, negative)):
        own = examples.positive == sign
        if own.any():
            groups, place = np.unique(examples.groups[own], return_inverse=True)
            weights[own] = total / len(groups) * wrong[own] / np.bincount(place, wrong[own])[place]
    return weights
