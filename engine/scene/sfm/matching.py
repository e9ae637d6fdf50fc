"""Matches between the features of two photos: over all features, or along epipolar lines.

Products of 8-bit descriptors are exact: a float32 product of 128 of them stays below 2²⁴.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .features import Features
from .kernels.descriptors import best_along_lines, best_of_columns, best_of_rows

MOST_RATIO = 0.8
"""Largest angle to the best descriptor, relative to the second best (Lowe's ratio test)."""
MOST_ANGLE = 0.7
"""Largest angle between matching descriptors, in radians."""
_BLOCK = 1024
"""Rows of the matrix of products in memory at a time."""
_SQUARED_NORM = 512.0**2
"""Of a descriptor: COLMAP stores 512 times the unit vector."""
_RATIOS = np.arange(0.95, 0.45, -0.05)
"""Ratio tests to choose from along epipolar lines: there are few other features on a line, so chance matches pass."""
_DISPLACED, _DECOYS = 8.0, 2000
"""Distance of the lines that show how many matches chance gives, in tolerances, and about how many are searched."""
LEAST_EXCESS = 5
"""Matches on the lines beyond those of chance that show common content."""
_CHANCE = 3.0
"""Standard deviations by which the matches on the lines must exceed those of chance."""
_MOST_CHANCE = 0.35
"""Largest share of the matches on the lines that chance gives."""

MatchArray = NDArray[np.uint32]


def match(one: Features, other: Features) -> MatchArray:
    """(M, 2) features of both photos that are each other's nearest, and much nearer than the second nearest."""
    count, others = len(one), len(other)
    if count == 0 or others < 2:
        return np.zeros((0, 2), np.uint32)
    mine, theirs = one.descriptors.astype(np.float32), other.descriptors.astype(np.float32).T
    best, second = np.empty(count, np.float32), np.empty(count, np.float32)
    column, highest = np.empty(count, np.int32), np.full(others, -1.0, np.float32)
    for start in range(0, count, _BLOCK):
        rows = slice(start, start + _BLOCK)
        products = mine[rows] @ theirs
        best_of_rows(products, best[rows], second[rows], column[rows])
        best_of_columns(products, highest)
    angles = _angles(best)
    good = (best == highest[column]) & (angles < MOST_ANGLE) & (angles < MOST_RATIO * _angles(second))
    index = np.flatnonzero(good)
    return np.stack([index, column[index]], axis=1).astype(np.uint32)


def match_along_lines(
    fundamental: NDArray[np.float64], one: Features, other: Features, tolerance: float, *, least: int = LEAST_EXCESS
) -> MatchArray | None:
    """(M, 2) matches within `tolerance` pixels of the epipolar lines; None if they are not more than chance gives.

    fundamental: (3, 3), from pixels of `one` to lines of `other`; least: matches beyond those of chance, in addition to
    its deviation. Matches along lines that are displaced to both sides show how many chance gives at each ratio test.
    The loosest test that keeps its share small is used.
    """
    lines = _lines(fundamental, one.positions)
    ratios, column = _ratios(lines, one, other, tolerance)
    step = max(len(one) // _DECOYS, 1)
    sides = np.where(np.arange(len(one)) // step % 2, 1.0, -1.0)[:, None]
    decoys = (lines + sides * [0.0, 0.0, _DISPLACED * tolerance]).astype(np.float32)[::step]
    by_chance, _ = _ratios(decoys, one.select(np.arange(0, len(one), step)), other, tolerance)
    for most in _RATIOS:
        found, chance = int((ratios < most).sum()), step * int((by_chance < most).sum())
        if chance <= _MOST_CHANCE * found and found - chance > _CHANCE * np.sqrt(step * chance) + least:
            break
    else:
        return None
    index = np.flatnonzero(ratios < most)
    back = other.select(column[index])
    mutual = _ratios(_lines(fundamental.T, back.positions), back, one, tolerance)[1] == index
    return np.stack([index[mutual], column[index[mutual]]], axis=1).astype(np.uint32)


def _ratios(
    lines: NDArray[np.float32], one: Features, other: Features, tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """(N,) angle to the best descriptor on each line over that to the second best, infinite without a good one; (N,)
    the best."""
    best = np.empty((len(one), 3), np.int32)
    best_along_lines(lines, one.descriptors, other.positions, other.descriptors, tolerance, best)
    angles = _angles(best[:, 0])
    ratios = angles / np.maximum(_angles(best[:, 1]), 1e-6)
    return np.where((best[:, 2] >= 0) & (angles < MOST_ANGLE), ratios, np.inf), best[:, 2]


def _angles(products: NDArray[np.float32] | NDArray[np.int32]) -> NDArray[np.float64]:
    """Angles in radians between descriptors, from their products."""
    angles: NDArray[np.float64] = np.arccos(np.clip(products / _SQUARED_NORM, 0.0, 1.0))
    return angles


def _lines(fundamental: NDArray[np.float64], positions: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 3) epipolar lines of the positions, with unit normals."""
    lines = np.column_stack([positions, np.ones(len(positions))]) @ fundamental.T
    return np.ascontiguousarray(lines / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12)[:, None], np.float32)
