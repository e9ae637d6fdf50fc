"""Long fruit from points of their skin: how long they are and which way, and round fruit that stay round."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fruitlangs.engine.counting.geometry.cells import Cells
from fruitlangs.engine.counting.geometry.ellipsoid import Ellipsoids, fit_ellipsoids
from fruitlangs.engine.counting.geometry.sphere import Spheres, unit_directions

NOISE, TILT = 0.03, 0.25
"""Of points off the skin, in diameters, and of normals, radians."""


def fruit(half_axes: tuple[float, float, float], count: int = 60, seen: float = -0.3, seed: int = 0):
    """Points of ellipsoids that face up by `seen` or more, with normals and owners; centres (F, 3) and turns (F, 3, 3)
    whose columns the half axes lie along. They are of volume 4/3 π, in a row."""
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, random_state=rng).as_matrix()
    centers = np.arange(count)[:, None] * [5.0, 0.0, 0.0]
    axes = np.array(half_axes) / np.cbrt(np.prod(half_axes))
    positions, normals, owners = [], [], []
    for number in range(count):
        ball = unit_directions(500)
        surface, outward = (ball * axes) @ turns[number].T, (ball / axes) @ turns[number].T
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        shown = outward[:, 2] > seen
        tilted = outward[shown] + TILT * rng.standard_normal((shown.sum(), 3))
        positions.append(centers[number] + surface[shown] + 2.0 * NOISE * rng.standard_normal((shown.sum(), 3)))
        normals.append(tilted / np.linalg.norm(tilted, axis=1, keepdims=True))
        owners.append(np.full(int(shown.sum()), number))
    return np.concatenate(positions), np.concatenate(normals), np.concatenate(owners), centers, turns


def fitted(positions, normals, owners, centers, radius: float = 1.0) -> Ellipsoids:
    count, cells = len(centers), Cells.of(positions, 0.6 * radius)
    told = np.zeros(count)
    spheres = Spheres(centers, np.full(count, radius), told + 0.05 * radius, told, told, told, told, told, told)
    return fit_ellipsoids(cells, normals[cells.index], owners[cells.index], spheres)


def lengths(found: Ellipsoids) -> np.ndarray:
    """(F, 3) half axes in radii."""
    return np.linalg.norm(found.axes, axis=2)


@pytest.mark.parametrize("long", [1.2, 1.5])
def test_long_fruit_are_found_as_long_as_they_are_and_along_their_axis(long: float) -> None:
    *points, turns = fruit((long, 1.0, 1.0))
    found = fitted(*points)
    ratios = lengths(found)[:, 0] / np.sqrt(lengths(found)[:, 1:].prod(axis=1))
    assert np.median(ratios) == pytest.approx(long, rel=0.1)
    along = np.abs(np.einsum("fi,fi->f", found.axes[:, 0], turns[:, :, 0])) / lengths(found)[:, 0]
    assert np.degrees(np.arccos(np.median(along))) < 15.0
    assert np.median(found.spheres.radii) == pytest.approx(1.0, abs=0.05)


def test_round_fruit_stay_round() -> None:
    *points, _ = fruit((1.0, 1.0, 1.0))
    found = lengths(fitted(*points))
    assert np.median(found[:, 0] / found[:, 2]) < 1.06


def test_a_fruit_that_shows_a_cap_is_held_to_what_the_others_are() -> None:
    *points, _ = fruit((1.0, 1.0, 1.0), seen=0.6)
    found = fitted(*points)
    assert (lengths(found)[:, 0] / lengths(found)[:, 2]).max() < 1.25
    assert np.abs(found.spheres.radii - 1.0).max() < 0.1


def test_axes_have_the_volume_of_the_sphere_and_are_right_handed_and_fall() -> None:
    *points, _ = fruit((1.6, 1.2, 0.8))
    found = fitted(*points)
    assert np.linalg.det(found.axes) == pytest.approx(np.ones(len(found.axes)))
    assert (np.diff(lengths(found), axis=1) <= 0.0).all()


def test_fruit_turned_moved_and_scaled_have_their_axes_turned_alike() -> None:
    positions, normals, owners, centers, _ = fruit((1.5, 1.2, 1.0), count=20)
    turn = Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix()
    before = fitted(positions, normals, owners, centers)
    moved = fitted(3.0 * positions @ turn.T + 7.0, normals @ turn.T, owners, 3.0 * centers @ turn.T + 7.0, radius=3.0)
    assert lengths(moved) == pytest.approx(lengths(before), rel=0.05)
    assert moved.spheres.radii == pytest.approx(3.0 * before.spheres.radii, rel=0.02)
    along = np.abs(np.einsum("fi,fi->f", before.axes[:, 0] @ turn.T, moved.axes[:, 0]))
    assert np.median(along / lengths(before)[:, 0] / lengths(moved)[:, 0]) > 0.99


def test_points_of_a_neighbour_change_nothing() -> None:
    positions, normals, owners, centers, _ = fruit((1.0, 1.0, 1.0), count=2)
    alone = fitted(positions, normals, owners, centers)
    beside = positions[owners == 1] - [3.2, 0.0, 0.0]
    crowd = np.concatenate([positions, beside]), np.concatenate([normals, normals[owners == 1]])
    together = fitted(*crowd, np.concatenate([owners, np.ones(len(beside), np.int64)]), centers)
    assert together.axes[0] == pytest.approx(alone.axes[0], abs=0.02)


def test_no_fruit_have_no_axes() -> None:
    *points, _ = fruit((1.0, 1.0, 1.0), count=1)
    positions, normals, owners, centers = points
    assert fitted(positions, normals, np.full(len(owners), -1), centers[:0]).axes.shape == (0, 3, 3)
