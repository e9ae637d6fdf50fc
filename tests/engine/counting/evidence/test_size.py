"""The fruit's diameter, estimated from surface points alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fruitlangs.engine.counting.evidence.size import LEAST_EVIDENCE, estimate_diameter
from fruitlangs.engine.counting.evidence.surface_points import SurfacePoints
from fruitlangs.engine.counting.geometry.random_streams import even_turns


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
    own = normals[facing]
    return SurfacePoints(positions[facing], own, np.arange(count), np.ones(count), own, even_turns(count))


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_a_crown_that_is_round_itself_is_not_taken_for_the_fruit(noise: float) -> None:
    centers = 0.6 * directions(np.random.default_rng(1), 90)
    estimate = estimate_diameter(surfaces(centers, 0.08, 150, noise), 0.01)
    assert estimate is not None
    assert estimate.diameter == pytest.approx(0.08, rel=0.25)


def test_a_single_large_fruit_keeps_its_own_diameter() -> None:
    estimate = estimate_diameter(surfaces(np.array([[0.0, 0.0, 0.1]]), 1.0, 4000, 0.01), 0.02)
    assert estimate is not None
    assert estimate.diameter == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize(("noise", "round_"), [(0.02, True), (0.1, True), (0.4, False)])
def test_blurred_fruit_are_still_round_and_scatter_is_not(noise: float, round_: bool) -> None:
    rng = np.random.default_rng(2)
    points = surfaces(4.0 * directions(rng, 40), 1.0, 300, noise)
    tilted = points.normals + rng.normal(0.0, 2.0 * noise, points.normals.shape)
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    blurred = replace(points, normals=tilted)
    estimate = estimate_diameter(blurred, 0.05)
    assert (estimate is not None and estimate.evidence > LEAST_EVIDENCE) == round_
    if round_ and estimate is not None:
        assert estimate.diameter == pytest.approx(1.0, rel=0.15)


def test_sheets_of_leaves_are_not_round() -> None:
    rng = np.random.default_rng(3)
    flats = []
    for middle in rng.uniform(-3, 3, (30, 3)):
        across = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        spots = middle + (rng.uniform(-1, 1, (200, 2)) * [0.6, 0.3]) @ across[:2] + rng.normal(0, 0.01, (200, 3))
        normal = across[2] * np.sign(across[2, 0])  # seen from x
        flats.append((spots, np.tile(normal, (200, 1))))
    positions, normals = (np.concatenate(each) for each in zip(*flats, strict=True))
    count = len(positions)
    points = SurfacePoints(positions, normals, np.arange(count), np.ones(count), normals, even_turns(count))
    estimate = estimate_diameter(points, 0.05)
    assert estimate is None or estimate.evidence < LEAST_EVIDENCE


@pytest.mark.parametrize(("kept", "smallest"), [(0, 0.05), (1, 0.05), (300, 0.0)])
def test_without_points_or_without_extent_nothing_is_round(kept: int, smallest: float) -> None:
    points = surfaces(np.zeros((1, 3)), 1.0, 300, 0.0).select(np.arange(kept))
    assert estimate_diameter(points, smallest) is None
