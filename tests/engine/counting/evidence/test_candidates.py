"""From surface points to likely fruit: balls, pairs of balls, sheets, and laws that every count obeys."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fruitlangs.engine.counting.evidence.candidates import OVERLAP, FruitSize, SurfaceIndex, vote
from fruitlangs.engine.counting.evidence.cluster import USUAL, USUALLY, Clusters, find_fruit, refine, search
from fruitlangs.engine.counting.evidence.surface_points import SurfacePoints
from fruitlangs.engine.counting.geometry.overlaps import Overlaps
from fruitlangs.engine.counting.geometry.random_streams import even_turns
from fruitlangs.engine.counting.geometry.sphere import Spheres

NOISE = 0.03
"""Standard deviation of points off the surface, in diameters."""


def directions(rng: np.random.Generator, count: int) -> np.ndarray:
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def seen_from(centers: np.ndarray, eye: np.ndarray, *, diameter: float = 1.0, each: int = 400, seed: int = 0):
    """Points on the sides of balls that face an eye far away, none of them inside another ball or behind one."""
    rng = np.random.default_rng(seed)
    normals = directions(rng, len(centers) * each)
    owner = np.repeat(np.arange(len(centers)), each)
    positions = centers[owner] + 0.5 * diameter * normals
    towards = eye / np.linalg.norm(eye)
    free = normals @ towards > 0.05
    for other, center in enumerate(centers):
        offset = center - positions
        along = offset @ towards
        miss = np.linalg.norm(offset - along[:, None] * towards, axis=1)
        free &= ~((owner != other) & (along > 0) & (miss < 0.5 * diameter))
    positions = positions[free] + rng.normal(0.0, NOISE * diameter, (int(free.sum()), 3))
    return points_of(positions, normals[free], np.tile(towards, (int(free.sum()), 1)))


def points_of(positions: np.ndarray, normals: np.ndarray, towards: np.ndarray) -> SurfacePoints:
    count = len(positions)
    return SurfacePoints(positions, normals, np.arange(count), np.ones(count), towards, even_turns(count))


def joined(*parts: SurfacePoints) -> SurfacePoints:
    positions, normals, towards = (
        np.concatenate([getattr(p, k) for p in parts]) for k in ("positions", "normals", "directions")
    )
    return points_of(positions, normals, towards)


def found(points: SurfacePoints, diameter: float = 1.0) -> Clusters:
    return find_fruit(search(points, FruitSize(diameter, 0.15), [], 0.5))


def off(clusters: Clusters, centers: np.ndarray) -> np.ndarray:
    """(F,) distance of each true centre from the nearest found one."""
    return np.linalg.norm(centers[:, None] - clusters.spheres.centers, axis=2).min(axis=1)


@pytest.mark.parametrize("seed", range(4))
def test_touching_pairs_seen_from_one_side_are_two_fruit_each(seed: int):
    rng = np.random.default_rng(seed)
    middles = np.stack(np.meshgrid(*[4.0 * np.arange(3)] * 3), axis=-1).reshape(-1, 3).astype(float)
    axes = directions(rng, len(middles))
    axes[:, 0] *= 0.5  # mostly next to each other as seen from x, so that the one behind shows more than half
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    pairs = np.stack([middles - 0.5 * axes, middles + 0.5 * axes], axis=1)
    parts = [seen_from(pair, np.array([1.0, 0.2, 0.1]), seed=seed) for pair in pairs]
    clusters = found(joined(*parts))
    numbers = (np.linalg.norm(clusters.spheres.centers[:, None] - middles, axis=2) < 1.2).sum(axis=0)
    assert (numbers == 2).mean() >= 0.95
    assert np.median(off(clusters, pairs.reshape(-1, 3))) < 0.1


def test_a_fruit_of_which_little_shows_is_a_centre_only_where_few_votes_are_asked_for():
    whole, corner = np.zeros((1, 3)), np.array([[4.0, 0.0, 0.0]])
    far = np.array([1.0, 0.2, 0.1])
    seen, little = seen_from(whole, far, each=2000), seen_from(corner, far, each=60)
    surface = SurfaceIndex.of(joined(seen, little), 1.0)
    asked = {share: vote(surface, 0.5, share) for share in (0.01, 0.5)}
    near = {share: np.linalg.norm(peaks - corner, axis=1).min() for share, peaks in asked.items()}
    assert near[0.01] < 0.2 < 3.0 < near[0.5]
    assert np.linalg.norm(asked[0.5], axis=1).min() < 0.05


def test_of_five_fruit_four_that_are_alike_do_not_make_the_fifth_unlikely():
    places, diameters = 4.0 * np.arange(5)[:, None] * [1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 1.0, 0.82]
    balls = [
        seen_from(place[None], towards, diameter=diameter, seed=number)
        for number, (place, diameter) in enumerate(zip(places, diameters, strict=True))
        for towards in np.vstack([np.eye(3), -np.eye(3)])
    ]
    probabilities = search(joined(*balls), FruitSize(1.0, 0.15), [], 0.5).probabilities
    assert len(probabilities) == 5
    assert probabilities.min() > 0.9


def test_doubling_every_point_changes_no_fruit():
    points = seen_from(3.0 * directions(np.random.default_rng(1), 12), np.array([0.0, 1.0, 0.0]))
    once, twice = found(points), found(joined(points, points))
    assert len(once.spheres) == len(twice.spheres) > 8
    assert off(twice, once.spheres.centers).max() < 0.02


@pytest.mark.parametrize("scale", [1e-3, 40.0])
def test_turning_moving_and_scaling_the_points_moves_the_fruit_alike(scale: float):
    points = seen_from(3.0 * directions(np.random.default_rng(2), 12), np.array([0.0, 1.0, 0.0]))
    turn, shift = Rotation.from_rotvec([0.3, 1.0, -2.0]).as_matrix(), np.array([100.0, -7.0, 3.0])
    moved = points_of(scale * (points.positions @ turn.T + shift), points.normals @ turn.T, points.directions @ turn.T)
    here, there = found(points), found(moved, scale)
    assert len(here.spheres) == len(there.spheres)
    assert off(there, scale * (here.spheres.centers @ turn.T + shift)).max() < 0.02 * scale


def test_a_leaf_is_refused_and_the_audit_says_why():
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(-1, 1, (600, 2)) * [1.0, 0.5], rng.normal(0, NOISE, 600)])
    up = np.tile([0.0, 0.0, 1.0], (600, 1))
    clusters = found(points_of(flat, up, up))
    assert len(clusters.spheres) == 0
    reasons = " ".join(clusters.refusals.values())
    assert "flat" in reasons or "no common centre" in clusters.refusal(0)


def test_points_that_are_all_alike_hold_no_fruit():
    same = np.zeros((50, 3))
    up = np.tile([0.0, 0.0, 1.0], (50, 1))
    assert len(found(points_of(same, up, up)).spheres) == 0


def test_the_size_is_refined_by_the_fruit_that_are_found_and_by_no_others():
    radii = np.array([1.0, 1.2, 0.8, 9.0])
    spheres = Spheres(np.zeros((4, 3)), radii, 0.05 * radii, *(np.ones(4) for _ in range(6)))
    size = refine(FruitSize(3.0, 0.3), spheres, np.array([0.9, 0.9, 0.9, 0.1]), spheres)
    assert size.diameter == pytest.approx(2.0 * (1.0 * 1.2 * 0.8) ** (1 / 3))
    own, held = 3 * 0.9 * (np.log(radii[:3]).var() + 0.05**2), USUALLY * USUAL**2
    assert size.spread == pytest.approx(np.sqrt((own + held) / (3 * 0.9 + USUALLY)))
    assert refine(FruitSize(3.0, 0.3), spheres, np.array([0.9, 0.9, 0.1, 0.1]), spheres).diameter == 3.0


def test_fruit_that_were_held_alike_are_as_different_as_loose_fits_of_them_say():
    def alike(spread: float) -> Spheres:
        radii = np.exp(spread * np.linspace(-1.7, 1.7, 41))
        return Spheres(np.zeros((41, 3)), radii, 0.02 * radii, *(np.ones(41) for _ in range(6)))

    held, sure = alike(0.1), np.full(41, 0.9)
    assert refine(FruitSize(2.0, 0.2), held, sure, held).spread == pytest.approx(0.11, abs=0.02)
    assert refine(FruitSize(2.0, 0.2), held, sure, alike(0.3)).spread == pytest.approx(0.31, abs=0.03)
    assert refine(FruitSize(2.0, 0.2), held, sure, alike(0.12)).spread == pytest.approx(0.12, abs=0.02)


def test_overlaps_are_those_with_chosen_spheres_of_any_size():
    rng = np.random.default_rng(0)
    centers, radii = rng.random((300, 3)), rng.uniform(0.01, 0.2, 300)
    overlaps = Overlaps.of(centers, radii, OVERLAP)
    overlaps.chosen[:60] = True
    apart = np.linalg.norm(centers - centers[:60, None], axis=2)
    expected = (apart < OVERLAP * (radii + radii[:60, None])).any(axis=0)
    assert [overlaps.any_chosen(index) for index in range(300)] == expected.tolist()
    assert 0 < expected[60:].sum() < 240
