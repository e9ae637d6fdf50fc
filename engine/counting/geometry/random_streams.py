"""Random numbers that depend on position: those of a Gaussian depend only on where it lies in the cameras' frame, so
they do not change when the scene is moved or when Gaussians elsewhere are added or removed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

GOLDEN = 0.6180339887498949
PLASTIC = (0.7548776662466927, 0.5698402909980532)
"""Steps of sequences that fill the unit interval and the unit square evenly at any length (Roberts 2018)."""
FINENESS = 4000.0
"""Positions are distinguished up to this share of the cameras' distance: far above the rounding of single precision."""
FARTHEST = 1e15
"""Number of these shares; positions farther out share the outermost one."""


@dataclass(frozen=True, eq=False)
class RandomStreams:
    """Three numbers in [0, 1) for each of G Gaussians (G, 3), and a key (G,) that Gaussians at one position share."""

    starts: FloatArray
    keys: NDArray[np.uint64]

    @classmethod
    def draw(cls, places: FloatArray, seed: int) -> RandomStreams:
        """The streams of positions (G, 3) in the cameras' frame."""
        cells = np.floor((places * FINENESS).clip(-FARTHEST, FARTHEST)).astype(np.int64).view(np.uint64)
        keys = np.full(len(places), seed, np.uint64)
        for axis in range(3):
            keys = _mix(keys + cells[:, axis])
        drawn = [_mix(keys + np.uint64(number)) >> np.uint64(11) for number in (1, 2, 3)]
        return cls(np.stack(drawn, axis=1) * 2.0**-53, keys)

    def number(self, owner: IntArray) -> IntArray:
        """(P,) the number of each point among those at its position; owner: (P,) the Gaussian of each, ascending."""
        counts = np.bincount(owner, minlength=len(self.keys))
        order = np.argsort(self.keys, kind="stable")
        before = np.cumsum(counts[order]) - counts[order]
        first = np.diff(self.keys[order], prepend=~self.keys[order[:1]]) != 0
        starts = np.empty(len(counts), np.int64)
        starts[order] = before - before[first][np.cumsum(first) - 1]
        own = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
        return starts[owner] + own

    def directions(self, owner: IntArray, numbers: IntArray) -> FloatArray:
        """(P, 3) unit vectors, spread evenly over the sphere at every position."""
        height = 1.0 - 2.0 * ((self.starts[owner, 0] + numbers * PLASTIC[0]) % 1.0)
        turn = 2.0 * np.pi * ((self.starts[owner, 1] + numbers * PLASTIC[1]) % 1.0)
        flat = np.sqrt(1.0 - height**2)
        return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)

    def turns(self, owner: IntArray, numbers: IntArray) -> FloatArray:
        """(P,) in [0, 1), spread evenly at every position: the points below a share are an even sample of all."""
        turns: FloatArray = (self.starts[owner, 2] + numbers * GOLDEN) % 1.0
        return turns


def even_turns(count: int) -> FloatArray:
    """(count,) turns of points that do not belong to Gaussians, in their order."""
    turns: FloatArray = (np.arange(1, count + 1) * GOLDEN) % 1.0
    return turns


def _mix(state: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix numbers that need not look random into numbers that do (the finaliser of SplitMix64, Steele et al. 2014)."""
    state = state + np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))
