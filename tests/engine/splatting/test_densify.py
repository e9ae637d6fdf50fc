"""Gaussians that come and go keep their budget, their moments and their place."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from splats import random_gaussians

from fruitlangs.engine.splatting.gaussians import PARAMETERS
from fruitlangs.engine.splatting.training.densify import (
    DensifyRules,
    GradientStats,
    clamp_sizes,
    densify,
    reset_opacity,
)
from fruitlangs.engine.splatting.training.parameters import Parameters

RULES = DensifyRules(gradient=0.5, max_gaussians=1000, small=0.08, opacity=0.005, oversize=10.0, extent=1.0)
MIDDLE = torch.zeros(3)


def started(n: int = 40, seed: int = 0) -> tuple[Parameters, GradientStats]:
    """Parameters with moments that tell them apart, every second Gaussian pulled."""
    parameters = Parameters.start(random_gaussians(n, 1, seed))
    for name in PARAMETERS:
        rows = torch.arange(1.0, n + 1).reshape(-1, *[1] * (parameters.first[name].ndim - 1))
        parameters.first[name] += rows
        parameters.second[name] += 2 * rows
    mean_gradients = GradientStats.none(n)
    mean_gradients.sums[::2] = torch.linspace(1.0, 2.0, len(mean_gradients.sums[::2]))
    mean_gradients.counts += 1
    return parameters, mean_gradients


def test_every_pulled_gaussian_adds_one() -> None:
    parameters, mean_gradients = started()
    densify(parameters, mean_gradients, RULES, MIDDLE, [0, 1])
    assert len(parameters) == 60
    assert all(len(table[name]) == 60 for table in (parameters.values, parameters.first) for name in PARAMETERS)


@pytest.mark.parametrize("budget", [40, 41, 47, 60])
def test_the_budget_is_kept(budget: int) -> None:
    parameters, mean_gradients = started()
    densify(parameters, mean_gradients, replace(RULES, max_gaussians=budget), MIDDLE, [0, 1])
    assert len(parameters) == budget


def test_the_strongest_pull_goes_first() -> None:
    parameters, mean_gradients = started()
    rules = replace(RULES, max_gaussians=41, small=100.0)
    strongest = parameters.values["means"][mean_gradients.sums.argmax()].clone()
    densify(parameters, mean_gradients, rules, MIDDLE, [0, 1])
    assert torch.equal(parameters.values["means"][-1], strongest)


def test_small_ones_are_cloned_with_fresh_moments_and_the_old_keep_theirs() -> None:
    parameters, mean_gradients = started()
    before = parameters.values["means"].clone()
    densify(parameters, mean_gradients, replace(RULES, small=100.0), MIDDLE, [0, 1])
    assert torch.equal(parameters.values["means"][:40], before)
    assert torch.equal(parameters.values["means"][40:], before[::2])
    assert torch.equal(parameters.first["opacity_logits"][:40], torch.arange(1.0, 41))
    assert float(parameters.second["means"][40:].abs().max()) == 0.0


def test_large_ones_are_split_into_two_smaller() -> None:
    parameters, mean_gradients = started()
    scales = parameters.values["log_scales"][::2].clone()
    densify(parameters, mean_gradients, replace(RULES, small=1e-6), MIDDLE, [0, 1])
    assert len(parameters) == 60
    halves = parameters.values["log_scales"][20:]
    torch.testing.assert_close(halves, (scales - math.log(1.6)).repeat(2, 1))


def test_faint_oversized_and_broken_ones_go() -> None:
    parameters, mean_gradients = started()
    mean_gradients.sums.zero_()
    parameters.values["opacity_logits"][3] = -8.0
    parameters.values["log_scales"][5] = 4.0
    parameters.values["means"][7] = float("nan")
    densify(parameters, mean_gradients, RULES, MIDDLE, [0, 1])
    assert parameters.first["opacity_logits"].tolist() == [k + 1.0 for k in range(40) if k not in (3, 5, 7)]


def test_far_ones_may_be_larger() -> None:
    parameters, mean_gradients = started()
    mean_gradients.sums.zero_()
    parameters.values["log_scales"][:2] = math.log(20.0)
    parameters.values["means"][0] = 100.0
    densify(parameters, mean_gradients, replace(RULES, oversize=0.5), MIDDLE, [0, 1])
    assert parameters.first["opacity_logits"][0] == 1.0
    assert parameters.first["opacity_logits"][1] == 3.0


def test_the_same_seed_splits_alike_and_another_does_not() -> None:
    results = []
    for seed in (1, 1, 2):
        parameters, mean_gradients = started()
        densify(parameters, mean_gradients, replace(RULES, small=1e-6), MIDDLE, [0, seed])
        results.append(parameters.values["means"])
    assert torch.equal(results[0], results[1])
    assert not torch.equal(results[0], results[2])


def test_a_reset_lowers_opacity_and_forgets_its_moments() -> None:
    parameters, _ = started()
    low = parameters.values["opacity_logits"].sigmoid() < 0.05
    before = parameters.values["opacity_logits"].clone()
    reset_opacity(parameters, 0.05)
    assert float(parameters.values["opacity_logits"].sigmoid().max()) <= 0.05 + 1e-6
    assert torch.equal(parameters.values["opacity_logits"][low], before[low])
    assert float(parameters.first["opacity_logits"].abs().max()) == 0.0
    assert float(parameters.first["means"].abs().max()) > 0.0


def test_pulls_are_means_over_the_views_that_drew() -> None:
    mean_gradients = GradientStats.none(2)
    mean_gradients.add(np.array([[0.3, 0.4], [0.0, 0.0]], np.float32), np.array([2, 0], np.int32), 20, 20)
    mean_gradients.add(np.zeros((2, 2), np.float32), np.array([2, 0], np.int32), 20, 20)
    torch.testing.assert_close(mean_gradients.means, torch.tensor([2.5, 0.0]))


def test_no_gaussian_grows_beyond_its_distance_or_the_extent_of_the_cameras() -> None:
    parameters = Parameters.start(random_gaussians(40, 1, 0))
    parameters.values["means"][:2] = torch.tensor([[30.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    before = parameters.values["log_scales"].clone()
    parameters.values["log_scales"][:2] = 9.0
    clamp_sizes(parameters, MIDDLE, 2.0)
    held = parameters.values["log_scales"]
    torch.testing.assert_close(held[0].exp(), torch.full((3,), 30.0))
    torch.testing.assert_close(held[1].exp(), torch.full((3,), 2.0))
    assert torch.equal(held[2:], before[2:])
