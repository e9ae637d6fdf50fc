"""Long fruit: spheres along one body are one fruit, and round fruit that touch stay apart."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from simulated_fruit import look_at, quats_along_z

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.long_fruit import ENOUGH, Parts, find_bodies, join_bodies
from fruitlangs.engine.counting.geometry.sphere import Spheres
from fruitlangs.engine.splatting.gaussians import Gaussians

RADIUS = 0.5
LONG = [
    ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 4.0),
    ((1.02, 0.0, 0.3), (0.0, 0.0, 1.0), 3.5),  # touches the first, side by side
    ((0.0, 4.0, -2.0), (0.1, 0.0, 1.0), 3.0),
    ((0.37, 4.0, 1.7), (0.1, 0.0, 1.0), 4.0),  # in a row with the third, with a gap of a fifth of a diameter
    ((4.0, 0.0, 0.0), (1.0, 1.0, 0.2), 4.0),
    ((-4.0, 1.0, 0.5), (0.3, -1.0, 1.0), 3.5),
    ((-4.0, 5.0, 0.0), (0.0, 1.0, 0.0), 3.0),
    ((4.0, -4.0, 1.0), (0.5, 0.2, -1.0), 3.5),
]
"""Middle, direction and aspect of bodies with round ends, in their diameters."""
CLUMPS = [
    [(x, 0.0, 0.0) for x in range(5)],
    [(0.0, 4.0, z) for z in range(3)],
    [(4.0, 4.0, 0.0), (5.0, 4.0, 0.0), (4.5, 4.0 + np.sqrt(0.75), 0.0), (4.5, 4.3, 0.82)],
    [(-4.0, 0.0, 0.0), (-4.0, 0.0, 1.0)],
]
"""Centres of balls of diameter 1 that touch, also in straight rows."""


def spheres_at(centers: np.ndarray, radii: np.ndarray) -> Spheres:
    count = len(centers)
    return Spheres(
        centers=centers,
        radii=radii,
        radius_sds=np.full(count, 0.02),
        support=np.full(count, 30.0),
        shell=np.ones(count),
        coverage=np.full(count, 0.5),
        thinness=np.full(count, 0.3),
        residual=np.full(count, 0.05),
        agreement=np.full(count, 0.9),
    )


def ends_of(middle: Sequence[float], direction: Sequence[float], aspect: float) -> tuple[np.ndarray, np.ndarray]:
    """The centres of the round ends of a body."""
    half = (aspect - 1.0) * RADIUS * np.array(direction) / np.linalg.norm(direction)
    return np.array(middle) - half, np.array(middle) + half


def surface_of(rng: np.random.Generator, one: np.ndarray, other: np.ndarray, a_unit: int) -> tuple[np.ndarray, ...]:
    """Points on the body between two ends, evenly, `a_unit` on a unit of area, and their normals."""
    length = float(np.linalg.norm(other - one))
    count = round(a_unit * 2 * np.pi * RADIUS * (2 * RADIUS + length))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if length == 0.0:
        return one + RADIUS * normals, normals
    along = (other - one) / length
    tube = rng.random(count) < length / (2 * RADIUS + length)
    normals[tube] -= (normals[tube] @ along)[:, None] * along
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    anchors = np.where((normals @ along < 0.0)[:, None], one, other)
    anchors[tube] = one + rng.random((tube.sum(), 1)) * (other - one)
    return anchors + RADIUS * normals, normals


def outside_of(points: np.ndarray, ends: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """(P,) which points lie in no body."""
    free = np.ones(len(points), bool)
    for one, other in ends:
        step = other - one
        share = np.clip((points - one) @ step / max(float(step @ step), 1e-12), 0.0, 1.0)
        free &= np.linalg.norm(points - one - share[:, None] * step, axis=1) > RADIUS - 1e-6
    return free


def points_on(
    ends: Sequence[tuple[np.ndarray, np.ndarray]], seed: int = 0, seen_from: np.ndarray | None = None
) -> np.ndarray:
    """Noisy points on the outside of all bodies, on all sides or only on those that face one direction."""
    rng = np.random.default_rng(seed)
    drawn = [surface_of(rng, one, other, 100) for one, other in ends]
    points, normals = (np.concatenate([each[column] for each in drawn]) for column in range(2))
    kept = outside_of(points, ends)
    if seen_from is not None:
        kept &= normals @ seen_from > 0.0
    points = points[kept]
    return points + rng.normal(0.0, 0.02, points.shape)


def spheres_along(ends: Sequence[tuple[np.ndarray, np.ndarray]], seed: int = 1) -> tuple[Spheres, np.ndarray]:
    """About one sphere a diameter along each body, as roughly placed as fits place them; and the body of each."""
    rng = np.random.default_rng(seed)
    centers, owners = [], []
    for body, (one, other) in enumerate(ends):
        count = round(float(np.linalg.norm(other - one))) + 1
        centers.append(one + np.linspace(0.0, 1.0, count)[:, None] * (other - one))
        owners += [body] * count
    placed = np.concatenate(centers)
    placed += rng.normal(0.0, 0.03, placed.shape)
    return spheres_at(placed, RADIUS * rng.uniform(0.95, 1.05, len(placed))), np.array(owners)


def groups(numbers: np.ndarray) -> set[frozenset[int]]:
    return {frozenset(np.flatnonzero(numbers == number).tolist()) for number in np.unique(numbers)}


@pytest.fixture(scope="module")
def long_ends() -> list[tuple[np.ndarray, np.ndarray]]:
    return [ends_of(*body) for body in LONG]


@pytest.fixture(scope="module")
def long_points(long_ends) -> np.ndarray:
    return points_on(long_ends)


def test_spheres_along_long_bodies_that_touch_or_follow_each_other_are_one_fruit_a_body(long_ends, long_points) -> None:
    for seed in range(5):
        spheres, owners = spheres_along(long_ends, seed)
        numbers = find_bodies(long_points, spheres)
        assert numbers is not None
        assert groups(numbers) == groups(owners)
        assert sorted(set(numbers.tolist())) == list(range(len(LONG)))


@pytest.mark.parametrize("seed", range(4))
def test_bodies_that_are_seen_from_one_side_only_are_still_one_fruit_each(seed: int, long_ends) -> None:
    spheres, owners = spheres_along(long_ends, seed)
    towards = Rotation.random(random_state=seed).as_matrix()[0]
    numbers = find_bodies(points_on(long_ends, seen_from=towards), spheres)
    assert numbers is not None
    assert groups(numbers) == groups(owners)


def test_balls_in_touching_clumps_and_rows_are_not_long() -> None:
    centers = np.array([center for clump in CLUMPS for center in clump])
    points = points_on([(center, center) for center in centers])
    assert find_bodies(points, spheres_at(centers, np.full(len(centers), RADIUS))) is None


def test_a_few_long_fruit_among_many_balls_do_not_make_the_scene_long(long_ends) -> None:
    centers = np.array([center for clump in CLUMPS for center in clump]) + [20.0, 0.0, 0.0]
    few = long_ends[4:6]
    spheres, _ = spheres_along(few)
    every = spheres_at(np.vstack([centers, spheres.centers]), np.full(len(centers) + len(spheres), RADIUS))
    points = points_on([*few, *((center, center) for center in centers)])
    assert len(spheres) > ENOUGH
    assert find_bodies(points, spheres) is not None
    assert find_bodies(points, every) is None


def test_too_few_spheres_do_not_tell_whether_fruit_are_long(long_ends, long_points) -> None:
    spheres, _ = spheres_along(long_ends)
    assert find_bodies(long_points, spheres.select(np.arange(ENOUGH))) is not None
    assert find_bodies(long_points, spheres.select(np.arange(ENOUGH - 1))) is None
    assert find_bodies(long_points, spheres.select(np.arange(0))) is None


def test_the_order_of_spheres_and_points_makes_no_difference(long_ends, long_points) -> None:
    spheres, owners = spheres_along(long_ends)
    rng = np.random.default_rng(3)
    for _ in range(5):
        order = rng.permutation(len(spheres))
        numbers = find_bodies(rng.permutation(long_points), spheres.select(order))
        assert numbers is not None
        assert groups(numbers) == groups(owners[order])


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_bodies_do_not_depend_on_where_the_scene_lies_or_on_its_unit(scale: float, long_ends, long_points) -> None:
    spheres, owners = spheres_along(long_ends)
    turn = Rotation.random(random_state=4).as_matrix()
    shift = np.array([7.0, -50.0, 20.0])
    moved = spheres_at(scale * spheres.centers @ turn.T + shift, scale * spheres.radii)
    numbers = find_bodies(scale * long_points @ turn.T + shift, moved)
    assert numbers is not None
    assert groups(numbers) == groups(owners)


@pytest.fixture
def pair() -> Spheres:
    """Three spheres along one body, unevenly, one that is alone, and two along another body."""
    centers = [(0.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 2.0, 0.0), (5.0, 5.0, 5.0), (1.0, 1.0, 9.0), (2.0, 2.0, 10.0)]
    return spheres_at(np.array(centers), np.array([0.4, 0.6, 0.5, 0.7, 0.3, 0.3]))


NUMBERS = np.array([0, 0, 0, 1, 2, 2])


def test_a_body_has_the_volume_of_a_cylinder_with_round_ends(pair: Spheres) -> None:
    together, _, _ = join_bodies(pair, NUMBERS)
    volumes = 4.0 / 3.0 * np.pi * together.radii**3
    widths, lengths = np.array([0.5, 0.7, 0.3]), np.array([2.0, 0.0, np.sqrt(3.0)])
    np.testing.assert_allclose(volumes, np.pi * widths**2 * lengths + 4.0 / 3.0 * np.pi * widths**3)


def test_a_body_lies_in_the_middle_between_its_outermost_spheres(pair: Spheres) -> None:
    together, _, _ = join_bodies(pair, NUMBERS)
    np.testing.assert_allclose(together.centers, [[0.0, 1.0, 0.0], [5.0, 5.0, 5.0], [1.5, 1.5, 9.5]], atol=1e-12)


def test_half_axes_reach_the_tip_and_the_side_of_the_body_and_are_right_handed(pair: Spheres) -> None:
    together, axes, _ = join_bodies(pair, NUMBERS)
    halves = axes * together.radii[:, None, None]
    lengths = np.linalg.norm(halves, axis=2)
    np.testing.assert_allclose(
        lengths, [[1.5, 0.5, 0.5], [0.7, 0.7, 0.7], [0.3 + np.sqrt(3.0) / 2, 0.3, 0.3]], rtol=1e-12
    )
    np.testing.assert_allclose(np.abs(halves[0, 0]), [0.0, 1.5, 0.0], atol=1e-12)
    assert np.abs(halves[2, 0] @ np.ones(3)) / np.sqrt(3.0) == pytest.approx(lengths[2, 0])
    frames = halves / lengths[:, :, None]
    np.testing.assert_allclose(frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), (3, 3, 3)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)


def test_frames_are_right_handed_in_every_direction() -> None:
    directions = Rotation.random(40, random_state=5).as_matrix()[:, 0]
    centers = np.stack([np.zeros_like(directions), directions], axis=1).reshape(-1, 3)
    _, axes, _ = join_bodies(spheres_at(centers, np.full(80, 0.5)), np.repeat(np.arange(40), 2))
    assert (np.linalg.det(axes) > 0.0).all()
    along = axes[:, 0] / np.linalg.norm(axes[:, 0], axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", along, directions)), 1.0)


def test_a_body_has_the_points_of_all_its_spheres_and_their_mean_qualities(pair: Spheres) -> None:
    uneven = replace(pair, support=np.arange(1.0, 7.0), coverage=np.array([0.1, 0.2, 0.6, 0.5, 0.4, 0.8]))
    together, _, _ = join_bodies(uneven, NUMBERS)
    assert together.support.tolist() == [6.0, 4.0, 11.0]
    np.testing.assert_allclose(together.coverage, [0.3, 0.5, 0.6])


def test_bodies_remember_the_spheres_that_they_consist_of(pair: Spheres) -> None:
    _, _, parts = join_bodies(pair, NUMBERS)
    np.testing.assert_array_equal(parts.centers, pair.centers)
    np.testing.assert_array_equal(parts.radii, pair.radii)
    assert parts.owners.tolist() == NUMBERS.tolist()


def test_parts_of_fruit_that_are_left_out_go_and_the_others_follow_their_new_numbers() -> None:
    parts = Parts(np.arange(18.0).reshape(6, 3), np.arange(6.0), np.array([0, 0, 0, 1, 2, 2]))
    kept = parts.keep(np.array([1, -1, 0]))
    assert kept.radii.tolist() == [0.0, 1.0, 2.0, 4.0, 5.0]
    assert kept.owners.tolist() == [1, 1, 1, 0, 0]
    np.testing.assert_array_equal(kept.centers, parts.centers[[0, 1, 2, 4, 5]])


def test_a_candidate_is_the_share_of_a_fruit_that_its_nearest_part_is(pair: Spheres) -> None:
    _, _, parts = join_bodies(pair, NUMBERS)
    places = np.array([[0.1, 1.9, 0.0], [5.0, 5.0, 4.0], [2.0, 2.0, 12.0], [0.0, 0.3, 0.0]])
    np.testing.assert_allclose(parts.shares(places), [1 / 3, 1.0, 1 / 2, 1 / 3])
    none = parts.keep(np.array([-1, -1, -1]))
    assert none.shares(places).tolist() == [1.0] * 4


def gaussians_on(ends: Sequence[tuple[np.ndarray, np.ndarray]], seed: int = 0) -> Gaussians:
    """Flat opaque Gaussians on the outside of all bodies, a little below the surface that they draw."""
    rng = np.random.default_rng(seed)
    drawn = [surface_of(rng, one, other, 70) for one, other in ends]
    points, normals = (np.concatenate([each[column] for each in drawn]) for column in range(2))
    free = outside_of(points, ends)
    points, normals = points[free], normals[free]
    size = 0.08
    spots = points - 0.75 * size * normals + rng.normal(0.0, 0.02, points.shape)
    scales = np.tile([size, size, 0.25 * size], (len(points), 1))
    return Gaussians(
        means=torch.tensor(spots, dtype=torch.float32),
        log_scales=torch.tensor(np.log(scales), dtype=torch.float32),
        quats=torch.tensor(quats_along_z(normals + rng.normal(0.0, 0.15, normals.shape)), dtype=torch.float32),
        opacity_logits=torch.full((len(points),), 2.0),
        sh=torch.tensor(rng.normal(0.0, 0.3, (len(points), 1, 3)), dtype=torch.float32),
    )


def test_long_fruit_made_of_gaussians_are_counted_once_each_with_their_length_and_width() -> None:
    middles, directions, aspect = np.array([body[0] for body in LONG]), np.array([body[1] for body in LONG]), 3.0
    gaussians = gaussians_on([ends_of(*each, aspect) for each in zip(middles, directions, strict=True)])
    turns = np.arange(12) * 2 * np.pi / 12
    eyes = [14.0 * np.array([np.cos(turn), np.sin(turn), (-0.2, 0.5)[view % 2]]) for view, turn in enumerate(turns)]
    cameras = [look_at(eye, np.array([0.0, 1.0, 0.0]), focal=260.0) for eye in eyes]
    config = CountConfig(sample_budget=10_000)
    result = count_fruit(gaussians, np.full(len(gaussians), 0.9), cameras, config, label="fig")
    bodies_of = [int(np.linalg.norm(middles - fruit.center, axis=1).argmin()) for fruit in result.fruits]
    assert sorted(bodies_of) == list(range(len(LONG)))
    assert result.interval is not None
    assert 6 <= result.interval[0] <= len(LONG) <= result.interval[1] <= 11  # certain parts make no doubt
    for fruit, body in zip(result.fruits, bodies_of, strict=True):
        along = fruit.axes[0] / np.linalg.norm(fruit.axes[0])
        assert np.linalg.norm(fruit.center - middles[body]) < 0.25
        np.testing.assert_allclose(fruit.lengths, [aspect, 1.0, 1.0], rtol=0.15)
        assert abs(along @ directions[body]) / np.linalg.norm(directions[body]) > 0.95
        assert np.ptp(gaussians.means.numpy()[fruit.members] @ along) > 0.7 * aspect
        own = result.points[result.point_fruit_ids == fruit.id]
        assert np.ptp(own @ along) > 0.7 * aspect
        assert fruit.volume == pytest.approx(np.pi / 4 * (aspect - 1.0) + np.pi / 6, rel=0.2)


def test_one_long_fruit_is_one_body_alone_and_next_to_a_ball(long_ends) -> None:
    alone, _ = spheres_along(long_ends[:1])
    ball = np.array([9.0, 0.0, 0.0])
    with_ball = spheres_at(np.vstack([alone.centers, ball]), np.full(len(alone) + 1, RADIUS))
    assert find_bodies(points_on(long_ends[:1]), alone).tolist() == [0] * len(alone)
    assert find_bodies(points_on([*long_ends[:1], (ball, ball)]), with_ball).tolist() == [0] * len(alone) + [1]


def test_three_balls_in_a_row_are_three_fruit() -> None:
    centers = np.array([(0.0, 4.0, float(z)) for z in range(3)])
    points = points_on([(center, center) for center in centers])
    assert find_bodies(points, spheres_at(centers, np.full(3, RADIUS))) is None
