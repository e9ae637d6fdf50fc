"""The volume of alpha shapes: known bodies, laws, degenerate points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from fruitlangs.engine.counting.geometry.alpha_shape import alpha_shape_volume
from fruitlangs.engine.counting.geometry.sphere import unit_directions

QUICK = settings(max_examples=25)
seeds = st.integers(0, 10_000)


def cloud(seed: int, count: int = 60) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3))


def test_a_hollow_ball_is_filled_by_a_radius_above_its_own_and_empty_below() -> None:
    points = unit_directions(500) + np.random.default_rng(0).normal(0.0, 1e-4, (500, 3))
    assert alpha_shape_volume(points, 1.1) == pytest.approx(4.0 / 3.0 * np.pi, rel=0.03)
    assert alpha_shape_volume(points, 0.5) < 0.05


def test_a_gap_that_the_ball_enters_does_not_count() -> None:
    two = np.concatenate([unit_directions(400) - [2.5, 0.0, 0.0], unit_directions(400) + [2.5, 0.0, 0.0]])
    ball = alpha_shape_volume(unit_directions(400), 1.2)
    assert alpha_shape_volume(two, 1.2) == pytest.approx(2.0 * ball, rel=0.05)
    assert alpha_shape_volume(two, np.inf) > 3.0 * ball


@QUICK
@given(seed=seeds)
def test_an_infinite_radius_gives_the_convex_hull(seed: int) -> None:
    points = cloud(seed)
    assert alpha_shape_volume(points, np.inf) == pytest.approx(ConvexHull(points).volume)


@QUICK
@given(seed=seeds, radius=st.floats(0.1, 2.0), more=st.floats(1.0, 3.0))
def test_a_larger_radius_never_gives_less(seed: int, radius: float, more: float) -> None:
    assert alpha_shape_volume(cloud(seed), more * radius) >= alpha_shape_volume(cloud(seed), radius)


@QUICK
@given(seed=seeds, size=st.floats(1e-3, 1e3), shift=st.floats(-100, 100))
def test_turning_moving_and_scaling_scales_the_volume(seed: int, size: float, shift: float) -> None:
    turn = Rotation.random(random_state=seed).as_matrix()
    moved = size * (cloud(seed) @ turn.T + shift)
    assert alpha_shape_volume(moved, 0.5 * size) == pytest.approx(
        size**3 * alpha_shape_volume(cloud(seed), 0.5), rel=1e-5, abs=1e-9 * size**3
    )


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        cloud(0, 3),
        np.zeros((9, 3)),
        np.outer(np.arange(9.0), [1.0, 2.0, 3.0]),
        cloud(0, 40) * [1.0, 1.0, 0.0],
    ],
    ids=["none", "three", "one place", "a line", "a plane"],
)
def test_points_without_a_volume_have_none(points: np.ndarray) -> None:
    assert alpha_shape_volume(points, 1.0) == 0.0


def test_a_point_that_is_not_finite_is_refused() -> None:
    points = cloud(0)
    points[3, 1] = np.nan
    with pytest.raises(ValueError, match=r"nan|NaN|finite"):
        alpha_shape_volume(points, 1.0)
