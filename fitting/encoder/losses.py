"""The training loss: fruit and surroundings have fixed weights, however few pixels are fruit.

Both parts take the logarithms of the concepts' probabilities, (B, K, H, W), and the labels, (B, H, W).
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...engine.language.vocabulary import CONCEPTS, FRUITS
from .pictures import NOT_FRUIT

DOUBT = 0.5
"""Tolerance for pixels labelled only as no fruit that the network takes for fruit, because boxes miss fruit: 0 is
cross-entropy, 1 the mean absolute error (the q of Zhang and Sabuncu 2018, "Generalized Cross Entropy")."""


def concept_loss(log_probability: Tensor, labels: Tensor, *, fruit_share: float = 0.45, naming: float = 1.0) -> Tensor:
    """Cross-entropy.

    A pixel labelled only as no fruit uses the sum s of the probabilities of the surroundings, by (1 − s^q) / q. Every
    word is weighted by the root of its pixels; fruit words together make `fruit_share` of the loss, words of the
    surroundings the rest. A fruit pixel also has a loss for its kind alone, with weight `naming`.
    """
    known = labels < len(CONCEPTS)
    target = torch.where(known, labels, 0)
    exact = -log_probability.gather(1, target[:, None])[:, 0]
    fruit, others = log_probability.split([len(FRUITS), len(CONCEPTS) - len(FRUITS)], dim=1)
    kind = fruit.logsumexp(1) - fruit.gather(1, target.clamp_max(len(FRUITS) - 1)[:, None])[:, 0]
    exact = torch.where(target < len(FRUITS), exact + naming * kind, exact)
    vague = -torch.expm1(DOUBT * others.logsumexp(1)) / DOUBT
    loss = torch.where(known, exact, vague)
    bins = torch.where(labels == NOT_FRUIT, len(CONCEPTS), torch.where(known, labels, len(CONCEPTS) + 1))
    counts = torch.bincount(bins.flatten(), minlength=len(CONCEPTS) + 2)
    weights = counts.clamp_min(1).float().rsqrt()
    weights[-1] = 0.0
    mass = counts * weights
    weights[: len(FRUITS)] *= fruit_share / mass[: len(FRUITS)].sum().clamp_min(1.0)
    weights[len(FRUITS) :] *= (1.0 - fruit_share) / mass[len(FRUITS) :].sum().clamp_min(1.0)
    return (loss * weights[bins]).sum()


def overlap_loss(log_probability: Tensor, labels: Tensor) -> Tensor:
    """One minus the soft intersection over union of "fruit", mean over the pictures that show fruit.

    Cross-entropy weights pixels by word; this loss weights them by their effect on outlines, and makes them sharper.
    """
    known = (labels < len(CONCEPTS)) | (labels == NOT_FRUIT)
    fruit = (labels < len(FRUITS)).float()
    probability = log_probability[:, : len(FRUITS)].exp().sum(1) * known
    both = (probability * fruit).sum((1, 2))
    either = probability.sum((1, 2)) + fruit.sum((1, 2)) - both
    shows = fruit.sum((1, 2)) > 0
    return ((1.0 - both / either.clamp_min(1.0)) * shows).sum() / shows.sum().clamp_min(1)
