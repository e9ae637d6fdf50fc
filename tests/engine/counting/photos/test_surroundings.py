"""What Gaussians say about spheres."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fruitlangs.engine.counting.photos import surroundings
from fruitlangs.engine.counting.photos.surroundings import AROUND, WITHIN, Surroundings
from fruitlangs.engine.splatting.gaussians import Gaussians

RANDOM = np.random.default_rng(0)
MEANS, PROBABILITIES = RANDOM.random((500, 3)), RANDOM.random(500)
CENTERS, RADII, FRUIT = RANDOM.random((40, 3)), RANDOM.uniform(0.05, 0.2, 40), RANDOM.random((20, 3))


def around() -> Surroundings:
    gaussians = Gaussians(
        means=torch.from_numpy(MEANS),
        log_scales=torch.full((500, 3), -4.0),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(500, 1),
        opacity_logits=torch.zeros(500),
        sh=torch.zeros(500, 1, 3),
    )
    return Surroundings.of(gaussians, PROBABILITIES, FRUIT, 0.1, 0.5)


def test_gaussians_are_summed_within_the_reach_of_each_sphere() -> None:
    found, own = around().numbers(CENTERS, RADII), PROBABILITIES > 1.0 / 3.0
    distances = np.linalg.norm(MEANS - CENTERS[:, None], axis=2)
    matching = (distances <= AROUND * RADII[:, None]) & own
    others = (distances <= WITHIN * RADII[:, None]) & ~own
    np.testing.assert_allclose(found[:, 2], np.log1p(0.5 * matching.sum(axis=1)))
    np.testing.assert_allclose(found[:, 3], np.log1p(0.5 * others.sum(axis=1)))
    nearest = np.linalg.norm(FRUIT - CENTERS[:, None], axis=2).min(axis=1) / 0.1
    np.testing.assert_allclose(found[:, 0], np.minimum(nearest, surroundings.FARTHEST))


def test_trees_of_gaussians_and_fruit_are_built_once_for_all_spheres(monkeypatch: pytest.MonkeyPatch) -> None:
    built, make = list[int](), surroundings.cKDTree
    monkeypatch.setattr(surroundings, "cKDTree", lambda points: built.append(len(points)) or make(points))
    scene = around()
    for _ in range(3):
        scene.numbers(CENTERS, RADII)
    assert sorted(built) == sorted([int((PROBABILITIES > 1 / 3).sum()), int((PROBABILITIES <= 1 / 3).sum()), 20])


def test_a_scene_without_fruit_and_other_gaussians_has_none_around() -> None:
    gaussians = Gaussians(
        means=torch.from_numpy(MEANS[:1]), log_scales=torch.zeros(1, 3), quats=torch.eye(1, 4),
        opacity_logits=torch.zeros(1), sh=torch.zeros(1, 1, 3),
    )  # fmt: skip
    numbers = Surroundings.of(gaussians, np.ones(1), np.zeros((0, 3)), 0.1, 0.5).numbers(MEANS[:1] + 5.0, np.ones(1))
    assert numbers.tolist() == [[surroundings.FARTHEST, numbers[0, 1], 0.0, 0.0, 0.0]]
