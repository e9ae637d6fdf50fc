"""Gaussians as samples of a Markov chain (Kheradmand et al. 2024): dead Gaussians move to the positions of live ones.

The number of Gaussians grows to a budget and never falls; noise lets the faint ones explore. A move hardly changes the
picture: the copies of a Gaussian share its opacity and shrink accordingly.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray

from ..gaussians import Gaussians
from .parameters import Parameters

DEAD = 0.005
"""A fainter Gaussian is dead."""
NOISE = 1280.0
"""Noise of a position, times its covariance over the scene's extent, at the first step; it falls to a hundredth.

The authors have 5e5 times the learning rate, 1.6e-4 extents: the same where the extent is 4 units. Theirs grows with
the cube of the unit."""
SHARPNESS, KNEE = 100.0, 0.995
"""Noise fades with opacity as σ(-100 (opacity - 1 + 0.995))."""
MOST_COPIES = 51


def relocate(parameters: Parameters, most: int, remaining: int, seed: list[int]) -> None:
    """Move dead Gaussians to live ones, then add Gaussians; all positions are sampled by opacity.

    most: the budget; remaining: how many times this will be called, this one included: the number grows by the same
    factor every time and reaches the budget at the last.
    """
    random = np.random.default_rng(seed)
    opacities = parameters.gaussians().opacities.numpy().astype(np.float64)
    dead = np.flatnonzero(~(opacities > DEAD))
    living = np.flatnonzero(opacities > DEAD)
    if len(living) == 0:
        return
    if len(dead) > 0:
        _share(parameters, random.choice(living, len(dead), p=_normal(opacities[living])), dead)
    n = len(parameters)
    added = max(int(n * (most / n) ** (1.0 / max(remaining, 1))) - n, 0)
    if added > 0:
        opacities = parameters.gaussians().opacities.numpy().astype(np.float64)
        sources = random.choice(len(opacities), added, p=_normal(opacities))
        places = len(parameters) + np.arange(added)
        parameters.append(parameters.gaussians().select(torch.from_numpy(sources)), torch.from_numpy(sources))
        _share(parameters, sources, places)


def _normal(weights: NDArray[np.float64]) -> NDArray[np.float64]:
    return weights / weights.sum()


def _share(parameters: Parameters, sources: NDArray[np.int64], places: NDArray[np.int64]) -> None:
    """Put a copy of each source at its place; a source and its copies together look like the source before (eq. 9)."""
    n = len(parameters)
    copies = np.minimum(np.bincount(sources, minlength=n) + 1, MOST_COPIES)
    changed = np.unique(sources)
    opacities = parameters.gaussians().opacities.numpy().astype(np.float64)[changed]
    new, shrink = _share_opacity(opacities, copies[changed])
    at = torch.from_numpy(changed)
    parameters.values["opacity_logits"][at] = torch.from_numpy(np.log(new / (1.0 - new))).float()
    parameters.values["log_scales"][at] += torch.from_numpy(np.log(shrink)).float()[:, None]
    from_, to = torch.from_numpy(sources), torch.from_numpy(places)
    for name in parameters.values:
        parameters.values[name][to] = parameters.values[name][from_]
        for moments in (parameters.first, parameters.second):
            moments[name][at] = 0.0
            moments[name][to] = 0.0
    parameters.updates[at] = 0
    parameters.updates[to] = 0


def _share_opacity(
    opacities: NDArray[np.float64], copies: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the opacity of each of n copies, 1 - (1 - o)^(1/n), and the factor of their standard deviations (eq.
    9)."""
    new = np.clip(1.0 - (1.0 - np.minimum(opacities, 1.0 - 1e-6)) ** (1.0 / copies), DEAD, 1.0 - 1e-6)
    total = np.zeros_like(new)
    for i in range(1, int(copies.max()) + 1):
        term = sum(math.comb(i - 1, k) * (-1.0) ** k * new ** (k + 1) / math.sqrt(k + 1) for k in range(i))
        total += np.where(i <= copies, term, 0.0)
    return new, np.clip(opacities / np.maximum(total, 1e-12), 1e-3, 1.0)


def inject_noise(parameters: Parameters, extent: float, done: float, seed: list[int]) -> None:
    """Add noise to the positions, along the covariance of each Gaussian, more for fainter ones (eq. 8).

    extent: of the scene; done: share of the training that is over.
    """
    gaussians: Gaussians = parameters.gaussians()
    drawn = np.random.default_rng(seed).standard_normal((len(parameters), 3), dtype=np.float32)
    fade = torch.sigmoid(-SHARPNESS * (gaussians.opacities - (1.0 - KNEE)))
    turned = gaussians.rotations.transpose(1, 2) @ torch.from_numpy(drawn)[..., None]
    noise = (gaussians.rotations @ (gaussians.scales[..., None] ** 2 * turned))[..., 0]
    parameters.values["means"] += noise * (fade * (NOISE / extent * 0.01**done))[:, None]
