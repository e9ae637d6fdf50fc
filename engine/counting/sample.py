"""Surface points of the selected Gaussians (paper eq. 12), each with its normal and where it was seen from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..splatting.gaussians import Gaussians
from .visibility import Visibility

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """P points sampled from selected Gaussians.

    positions: (P, 3) scene units; normals: (P, 3) unit, out of the surface towards the cameras that saw it;
    gaussians: (P,) index of the Gaussian each came from; probabilities: (P,); directions: (P, 3) mean direction towards
    the seeing cameras.
    """

    positions: FloatArray
    normals: FloatArray
    gaussians: IntArray
    probabilities: FloatArray
    directions: FloatArray

    def __len__(self) -> int:
        return len(self.positions)

    def select(self, index: NDArray) -> SurfacePoints:
        """The points at `index` (bool mask (P,) or integer indices)."""
        return SurfacePoints(
            self.positions[index],
            self.normals[index],
            self.gaussians[index],
            self.probabilities[index],
            self.directions[index],
        )


def sample_surface(
    gaussians: Gaussians,
    probability: FloatArray,
    visibility: Visibility,
    selected: IntArray,
    *,
    budget: int,
    seed: int,
    largest: float = np.inf,
) -> SurfacePoints:
    """Sample `budget` points from the selected Gaussians, N_i ∝ det(Σ_i)^½ · α_i (paper eq. 12).

    Only Gaussians whose largest standard deviation is at most `largest` scene units give points: else a few big blurry
    ones would take the whole budget. Numbers are rounded by largest remainder, so they sum to the budget. Gaussians are
    drawn from in an order made of values that neither shuffling nor a rigid motion changes, so neither do the points.
    """
    scales = gaussians.scales.detach().double().cpu().numpy()
    selected = selected[scales[selected].max(axis=1) <= largest]
    selected = selected[canonical_order(gaussians, probability, selected)]
    opacities = gaussians.opacities.detach().double().cpu().numpy()[selected]
    logs = gaussians.log_scales.detach().double().cpu().numpy()[selected].sum(axis=1)
    counts = share_out(np.exp(logs - logs.max(initial=-np.inf)) * opacities, budget) if len(selected) else selected
    owner = np.repeat(np.arange(len(selected)), counts)

    axes = gaussians.rotations.detach().double().cpu().numpy()[selected]
    own = np.random.default_rng(seed).standard_normal((len(owner), 3)).clip(-2.0, 2.0)
    means = gaussians.means.detach().double().cpu().numpy()[selected]
    offsets = np.einsum("pij,pj->pi", axes[owner], own * scales[selected][owner])
    directions = visibility.directions[selected]
    flat = np.take_along_axis(axes, scales[selected].argmin(axis=1)[:, None, None], axis=2)[:, :, 0]
    normals = turn_towards(flat, directions)
    return SurfacePoints(
        means[owner] + offsets, normals[owner], selected[owner], probability[selected][owner], directions[owner]
    )


def share_out(shares: FloatArray, budget: int) -> IntArray:
    """Whole numbers (N,) that sum to `budget`, proportional to non-negative `shares` (N,), by largest remainder."""
    total = shares.sum()
    exact = shares * (budget / total) if total > 0 else np.full(len(shares), budget / len(shares))
    counts = np.floor(exact).astype(np.int64)
    rest = budget - int(counts.sum())
    counts[np.argsort(counts - exact, kind="stable")[:rest]] += 1
    return counts


def canonical_order(gaussians: Gaussians, probability: FloatArray, selected: IntArray) -> IntArray:
    """Order of the selected Gaussians by opacity, colour, probability and, only among equals, position."""
    colors = gaussians.sh[:, 0].detach().double().cpu().numpy()[selected]
    means = gaussians.means.detach().double().cpu().numpy()[selected]
    logits = gaussians.opacity_logits.detach().double().cpu().numpy()[selected]
    return np.lexsort((*means.T, probability[selected], *colors.T, logits))


def turn_towards(normals: FloatArray, directions: FloatArray) -> FloatArray:
    """The normals (N, 3), each flipped where it points away from its direction (N, 3)."""
    away = np.einsum("ij,ij->i", normals, directions) < 0.0
    return np.where(away[:, None], -normals, normals)
