"""Positions of the leaves, and how wind turns them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..shapes.branch import UP, Branch, to_unit
from ..species import Species

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Leaves:
    """Placed leaves: N rows each."""

    bases: FloatArray
    """(N, 3) where the leaf's stalk meets the wood."""
    frames: FloatArray
    """(N, 3, 3) columns: across the leaf, along its midrib, its upper side's normal."""
    lengths: FloatArray
    """(N,) midrib lengths in metres."""
    shades: FloatArray
    """(N,) from the darkest colour, 0, to the lightest, 1."""

    def select(self, rows: NDArray[np.int64]) -> Leaves:
        """Select the leaves with these numbers."""
        return Leaves(
            bases=self.bases[rows], frames=self.frames[rows], lengths=self.lengths[rows], shades=self.shades[rows]
        )

    def move(self, offset: FloatArray) -> Leaves:
        """Return the same leaves at other positions."""
        return Leaves(bases=self.bases + offset, frames=self.frames, lengths=self.lengths, shades=self.shades)


def place_leaves(rng: np.random.Generator, branches: Sequence[Branch], species: Species, count: int) -> Leaves:
    """Leaves along twigs and the outer parts of branches, facing the light, slightly hanging."""
    hosts = [b for b in branches if b.generation >= 2]
    spans = np.array([b.span for b in hosts])
    spans *= np.array([1.0 if b.generation == 3 else 0.6 for b in hosts])
    choice = rng.choice(len(hosts), size=count, p=spans / spans.sum())
    fractions = rng.beta(1.6, 1.0, size=count)
    bases = np.empty((count, 3))
    alongs = np.empty((count, 3))
    for n, (host, f) in enumerate(zip(choice, fractions, strict=True)):
        bases[n], alongs[n] = hosts[host].at(float(f))
    outward = to_unit(bases * [1, 1, 0] + [0, 0, 0.02])
    random = to_unit(rng.normal(size=(count, 3)))
    side = to_unit(random - (random * alongs).sum(axis=1, keepdims=True) * alongs)
    midribs = to_unit(0.55 * alongs + 0.85 * side + 0.35 * outward + [0, 0, -0.25])
    normals = UP + 0.35 * outward + rng.normal(0.0, 0.42, (count, 3))
    normals = to_unit(normals - (normals * midribs).sum(axis=1, keepdims=True) * midribs)
    across = np.cross(midribs, normals)
    return Leaves(
        bases=bases,
        frames=np.stack([across, midribs, normals], axis=2),
        lengths=species.leaf_length * np.clip(rng.normal(1.0, 0.16, count), 0.55, 1.35),
        shades=np.clip(rng.beta(2.0, 2.2, count) + 0.25 * (fractions - 0.6), 0.0, 1.0),
    )


def keep_outside(leaves: Leaves, centers: FloatArray, diameters: FloatArray) -> Leaves:
    """Keep the leaves whose midrib does not pass through a fruit, of (M, 3) centres and (M,) diameters."""
    keep = np.ones(len(leaves.bases), dtype=bool)
    for part in (0.3, 0.6, 0.9, 1.15):
        place = leaves.bases + part * leaves.lengths[:, None] * leaves.frames[:, :, 1]
        for center, diameter in zip(centers, diameters, strict=True):
            keep &= ((place - center) ** 2).sum(axis=1) > (0.52 * diameter) ** 2
    return leaves.select(np.flatnonzero(keep))


def rotate_in_wind(rng: np.random.Generator, leaves: Leaves, degrees: float) -> FloatArray:
    """Return the frames (N, 3, 3) of the leaves in wind: each rotates about a random axis by an angle of this
    deviation.

    The base of a leaf's stalk stays in place.
    """
    axis = to_unit(rng.normal(size=(len(leaves.bases), 3)))
    angle = np.radians(rng.normal(0.0, degrees, len(leaves.bases)))[:, None, None]
    zero = np.zeros(len(axis))
    x, y, z = axis.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    # Rodrigues' formula.
    turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)
    moved: FloatArray = turn @ leaves.frames
    return moved
