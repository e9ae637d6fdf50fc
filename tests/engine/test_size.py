"""The fruit's diameter, estimated from surface points alone."""

from __future__ import annotations

import numpy as np
import pytest

from fruitlangs.engine.counting.sample import SurfacePoints
from fruitlangs.engine.counting.size import estimate_diameter


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def surfaces(centers: np.ndarray, diameter: float, each: int, noise: float) -> SurfacePoints:
    """Points on balls, seen from outside the whole."""
    rng = np.random.default_rng(0)
    normals = directions(rng, len(centers) * each)
    positions = np.repeat(centers, each, axis=0) + 0.5 * diameter * normals
    positions += rng.normal(0.0, noise * diameter, positions.shape)
    outward = np.repeat(centers, each, axis=0)
    facing = (normals * outward).sum(axis=1) >= 0
    count = int(facing.sum())
    return SurfacePoints(positions[facing], normals[facing], np.arange(count), np.ones(count), normals[facing])


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_a_crown_that_is_round_itself_is_not_taken_for_the_fruit(noise: float) -> None:
    centers = 0.6 * directions(np.random.default_rng(1), 90)
    estimate = estimate_diameter(surfaces(centers, 0.08, 150, noise), 0.01, seed=0)
    assert estimate is not None
    assert estimate.diameter == pytest.approx(0.08, rel=0.25)


def test_a_single_large_fruit_keeps_its_own_diameter() -> None:
    estimate = estimate_diameter(surfaces(np.array([[0.0, 0.0, 0.1]]), 1.0, 4000, 0.01), 0.02, seed=0)
    assert estimate is not None
    assert estimate.diameter == pytest.approx(1.0, rel=0.1)
