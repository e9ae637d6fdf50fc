"""A prior for the kinds of fruit: a tree has one kind, so an ambiguous fruit is probably of the kind of the others."""

from __future__ import annotations

import torch
from torch import Tensor

PSEUDO_PIXELS = 300.0
"""Weight, in lifted pixels, of the prior that all kinds are equal; a scene with less fruit than this stays
unchanged."""
ASKED, ANY = 0.5, 0.05
"""Weights, as shares of the scene's fruit, of the priors that the prompt names a kind that is there, and that any kind
may be: an encoder errs equally on all fruit of a tree, so their number is weak evidence."""
ROUNDS = 50


def kind_shares(vectors: Tensor, weights: Tensor, kinds: Tensor, asked: Tensor) -> Tensor:
    """(K,) share of each kind in the fruit of the scene, by expectation maximisation.

    vectors: (N, D) unit features; weights: (N,) pixels of each Gaussian; kinds: (K, D) orthonormal text vectors of
    words that exclude each other, whose squared cosines are proportional to probabilities (Saerens, Latinne and
    Decaestecker 2002, "Adjusting the outputs of a classifier to new a priori probabilities"); asked: (K,) bool, which
    of them the prompt names.
    """
    likelihood = (vectors @ kinds.T).square().double()
    mass = (weights.double()[:, None] * likelihood).sum(1) * 2.0  # a block of unit length has half of the square
    likelihood = likelihood / likelihood.sum(1, keepdim=True).clamp_min(1e-12)
    shares = torch.full((len(kinds),), 1.0 / len(kinds), dtype=torch.float64)
    belief = (PSEUDO_PIXELS + ANY * mass.sum()) * shares
    belief = belief + ASKED * mass.sum() * asked / asked.sum().clamp_min(1)
    for _ in range(ROUNDS):
        belonging = likelihood * shares
        belonging = belonging / belonging.sum(1, keepdim=True).clamp_min(1e-12)
        shares = (mass[:, None] * belonging).sum(0) + belief
        shares = shares / shares.sum()
    return shares.float()


def weigh_for_scene(vectors: Tensor, weights: Tensor, kinds: Tensor, asked: Tensor) -> Tensor:
    """Weight the kinds of unit features (N, D) by their shares of the scene; the probability of fruit is unchanged.

    See `kind_shares`.
    """
    return weigh_kinds(vectors, kinds, kind_shares(vectors, weights, kinds, asked))


def weigh_kinds(vectors: Tensor, kinds: Tensor, shares: Tensor) -> Tensor:
    """Weight the kinds (K, D) of unit features (N, D) by shares (K,); the probability of fruit is unchanged."""
    cosines = vectors @ kinds.T
    weighed = cosines * shares.sqrt()
    length = cosines.norm(dim=1, keepdim=True) / weighed.norm(dim=1, keepdim=True).clamp_min(1e-12)
    return vectors + (weighed * length - cosines) @ kinds
