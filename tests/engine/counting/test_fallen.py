"""Fruit on the ground distinguished from hanging fruit, on artificial ground with known answers."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import simulated_fruit as sim
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.cluster import Search
from fruitlangs.engine.counting.evidence.size import FruitSize
from fruitlangs.engine.counting.evidence.visibility import Visibility
from fruitlangs.engine.counting.regions.ground import doubt_sunken, find_fallen
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians

FloatArray = NDArray[np.float64]

UP = np.array([0.0, 0.0, 1.0])
CROWN = np.array([[0.2, 0.1, 1.3], [-0.4, 0.2, 1.0], [0.5, -0.5, 1.6], [0.1, 0.6, 0.25]])
"""Fruit that hang; the last one's lowest point is two diameters above level ground."""
DIAMETER = 0.08


def flat(means: FloatArray, width: float) -> Gaussians:
    count = len(means)
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float32),
        log_scales=torch.full((count, 3), float(np.log(width))),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        opacity_logits=torch.full((count,), 3.0),
        sh=torch.zeros(count, 1, 3),
    )


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in PARAMETERS})


def relief(x: FloatArray, y: FloatArray, slope: float, bump: float) -> FloatArray:
    """Height of a sloping ground with a bank of height `bump` along x = 1."""
    return slope * y + bump * np.exp(-(((x - 1.0) / 0.4) ** 2))


def orchard(slope: float = 0.0, bump: float = 0.0) -> Gaussians:
    """Leaves in a crown about 1.2 above rough ground 5 across."""
    random = np.random.default_rng(6)
    x, y = random.uniform(-2.5, 2.5, (2, 4000))
    ground = np.stack([x, y, relief(x, y, slope, bump) + random.normal(0, 0.01, len(x))], axis=1)
    leaves = random.normal(0, 1, (3000, 3))
    leaves *= random.random((3000, 1)) ** (1 / 3) / np.linalg.norm(leaves, axis=1, keepdims=True)
    return joined(flat(0.9 * leaves + [0, 0, 1.2], 0.02), flat(ground, 0.04))


def fallen_on(slope: float = 0.0, bump: float = 0.0) -> FloatArray:
    """Three fruit that touch that ground, one of them on the bank."""
    x, y = np.array([[0.4, -0.7, 1.0], [0.3, 0.6, -0.2]])
    return np.stack([x, y, relief(x, y, slope, bump) + 0.5 * DIAMETER], axis=1)


def around(middle: FloatArray, up: FloatArray, scale: float = 1.0) -> list[Camera]:
    """A ring of cameras about a place."""
    turn = np.linalg.svd(up[None])[2][1:]
    places = [middle + 2.5 * scale * (np.cos(a) * turn[0] + np.sin(a) * turn[1]) for a in range(6)]
    return [sim.look_at(place, middle) for place in places]


def told(gaussians: Gaussians, centers: FloatArray, up: FloatArray = UP, scale: float = 1.0) -> list[bool | None]:
    """Whether fruit lie on the ground, seen from a ring about their middle."""
    cameras = around(centers.mean(axis=0), up, scale)
    return find_fallen(gaussians, cameras, centers, np.full(len(centers), DIAMETER * scale), up)


EXPECTED = [False] * 4 + [True] * 3


@pytest.mark.parametrize(("slope", "bump"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.12), (-0.25, 0.1)])
def test_fallen_fruit_are_reported_on_level_sloping_and_uneven_ground(slope: float, bump: float) -> None:
    hanging = CROWN + np.stack([0 * CROWN[:, 0], 0 * CROWN[:, 0], slope * CROWN[:, 1]], axis=1)
    assert told(orchard(slope, bump), np.vstack([hanging, fallen_on(slope, bump)])) == EXPECTED


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100), shift=st.floats(-5, 5))
def test_moving_turning_and_scaling_the_scene_leaves_fallen_fruit_alone(seed: int, scale: float, shift: float) -> None:
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    gaussians, centers = orchard(0.1, 0.1), np.vstack([CROWN, fallen_on(0.1, 0.1)])
    moved = dataclasses.replace(
        gaussians,
        means=torch.tensor(scale * (gaussians.means.double().numpy() + shift) @ turn.T, dtype=torch.float32),
        log_scales=gaussians.log_scales + float(np.log(scale)),
    )
    assert told(moved, scale * (centers + shift) @ turn.T, turn @ UP, scale) == EXPECTED


def test_without_a_ground_nothing_is_reported() -> None:
    gaussians = orchard()
    crown = gaussians.select(gaussians.means[:, 2] > 0.2)
    assert told(crown, CROWN) == [None] * 4
    assert told(gaussians.select(torch.zeros(0, dtype=torch.long)), CROWN) == [None] * 4
    assert find_fallen(gaussians, [], np.zeros((0, 3)), np.zeros(0), UP) == []


def test_a_surface_that_fruit_hang_below_is_no_ground() -> None:
    below_a_crown = CROWN - 1.25 * UP
    assert (below_a_crown[:, 2] < 0.0).any()
    assert told(orchard(), np.vstack([CROWN, below_a_crown])) == [None] * 8


def test_a_fruit_far_beyond_the_ground_that_is_seen_is_not_reported() -> None:
    assert told(orchard(), np.vstack([CROWN, fallen_on(), [[40.0, 0.0, 0.04]]])) == [*EXPECTED, None]


@pytest.mark.parametrize(("slope", "bump"), [(0.0, 0.0), (0.3, 0.0), (0.0, 0.12)])
def test_candidates_in_the_ground_are_doubted_and_fallen_and_hanging_ones_are_not(slope: float, bump: float) -> None:
    fallen = fallen_on(slope, bump)
    centers = np.vstack([CROWN, fallen, fallen - 0.5 * DIAMETER * UP])
    candidates = SimpleNamespace(spheres=SimpleNamespace(centers=centers))
    probabilities = np.array([0.99] * 4 + [0.7] * 6)
    found = Search(None, FruitSize(DIAMETER, 0.1), candidates, {}, probabilities)
    doubted = doubt_sunken(found, orchard(slope, bump), around(CROWN.mean(axis=0), UP), UP).probabilities
    assert (doubted[:7] == probabilities[:7]).all()
    assert (doubted[7:] < 0.5).all()


def test_a_ground_that_clear_fruit_lie_in_is_none() -> None:
    centers = np.vstack([CROWN, fallen_on() - 0.5 * DIAMETER * UP])
    candidates = SimpleNamespace(spheres=SimpleNamespace(centers=centers))
    found = Search(None, FruitSize(DIAMETER, 0.1), candidates, {}, np.array([0.99] * 5 + [0.7] * 2))
    doubted = doubt_sunken(found, orchard(), around(CROWN.mean(axis=0), UP), UP)
    assert np.array_equal(doubted.probabilities, found.probabilities)


def test_counted_fruit_say_whether_they_lie_on_the_ground() -> None:
    tree = sim.simulate(sim.Setting(fruit=8, clump=1, sheets=0, floaters=0, views=8), seed=5)
    bottoms = np.sort(tree.truth.centers[:, 2] - 0.5 * tree.truth.diameters)
    x, y = np.random.default_rng(3).uniform(-8, 8, (2, 3000))
    ground = flat(np.stack([x, y, np.full(3000, bottoms[0])], axis=1), 0.3)
    seen = Visibility(*(np.concatenate([part, np.zeros((3000, *part.shape[1:]))]) for part in (
        tree.visibility.weights, tree.visibility.views, tree.visibility.directions)))  # fmt: skip
    result = count_fruit(
        joined(tree.gaussians, ground),
        np.concatenate([tree.probability, np.zeros(3000)]),
        tree.cameras,
        CountConfig(sample_budget=4_000),
        label="apple",
        up=UP,
        visibility=seen,
    )
    low = np.array([fruit.center[2] - 0.5 * fruit.diameter - bottoms[0] for fruit in result.fruits])
    assert [fruit.fallen for fruit in result.fruits] == (low < 0.5).tolist()
    assert result.fallen is not None
    assert result.fallen >= 1
    assert (result.hanging or 0) + result.fallen == result.count
