"""The similarity that maps one reconstruction onto another, estimated from camera centres."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError

FloatArray = NDArray[np.float64]

_SAMPLES = 500
OUTLIER = 5.0
"""Views farther off than this many times the median are left out of the fit."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """p ↦ scale · rotation · p + translation.

    scale: target units per source unit; rotation: (3, 3); translation: (3,) target units.
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, points: FloatArray) -> FloatArray:
        """(…, 3) points of the source frame in the target's."""
        return self.scale * np.asarray(points, np.float64) @ self.rotation.T + self.translation

    def apply_to_lengths(self, lengths: FloatArray) -> FloatArray:
        """Lengths in source units, of any shape, in the target's."""
        return self.scale * np.asarray(lengths, np.float64)


def align(source: FloatArray, target: FloatArray) -> Similarity:
    """The similarity that maps `source` (N, 3) best to `target` (N, 3), row by row, for example two models' cameras.

    Least squares (Umeyama 1991) over the rows that agree: of fits to three rows each (all such triples, or 500 random
    ones, seeded) the one with the smallest median distance identifies outliers, so nearly half of the rows may be
    wrong.

    Raises:
        SceneError: fewer than 3 rows, other shapes, numbers that are not finite, or rows on one line (the rotation
            about it is then unknown).
    """
    source, target = np.asarray(source, np.float64), np.asarray(target, np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise SceneError(f"Centres of shapes {source.shape} and {target.shape} cannot be aligned. Give (N, 3) twice")
    if len(source) < 3:
        raise SceneError(f"{len(source)} views are common to both models, too few to align them. At least 3 are needed")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise SceneError("A camera centre is not finite. Leave that view out of the alignment")
    if _on_one_line(source) or _on_one_line(target):
        raise SceneError("The cameras stand on one line, so the rotation about it is unknown. Add a view off the line")
    best = _fit(source, target)
    least = float(np.median(_distances(best, source, target)))
    for rows in _triples(len(source)):
        if _on_one_line(source[rows]) or _on_one_line(target[rows]):
            continue
        candidate = _fit(source[rows], target[rows])
        median = float(np.median(_distances(candidate, source, target)))
        if median < least:
            best, least = candidate, median
    for _ in range(10):
        distances = _distances(best, source, target)
        spread = np.linalg.norm(target - np.median(target, axis=0), axis=1).max()
        near = distances <= max(OUTLIER * float(np.median(distances)), 1e-9 * spread)
        if _on_one_line(source[near]) or _on_one_line(target[near]):
            break
        best = _fit(source[near], target[near])
    return best


def _triples(count: int) -> list[list[int]]:
    if count <= 15:  # 455 triples
        return [list(rows) for rows in itertools.combinations(range(count), 3)]
    generator = np.random.default_rng(0)
    return [list(generator.choice(count, 3, replace=False)) for _ in range(_SAMPLES)]


def _fit(source: FloatArray, target: FloatArray) -> Similarity:
    """Umeyama's closed form: least squares over all rows, never a reflection."""
    source_mean, target_mean = source.mean(0), target.mean(0)
    centred = source - source_mean
    left, singular, right = np.linalg.svd((target - target_mean).T @ centred)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * signs) @ right
    scale = float((singular * signs).sum() / (centred**2).sum())
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def _distances(similarity: Similarity, source: FloatArray, target: FloatArray) -> FloatArray:
    return np.linalg.norm(similarity.apply(source) - target, axis=1)


def _on_one_line(points: FloatArray) -> bool:
    if len(points) < 3:
        return True
    singular = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return bool(singular[1] <= 1e-6 * max(singular[0], np.finfo(np.float64).tiny))
