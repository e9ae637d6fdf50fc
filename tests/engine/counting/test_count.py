"""Counting on simulated fruit surfaces: laws, settings, bad input."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import simulated_fruit as sim
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.cluster import SPREADS, UNTOLD
from fruitlangs.engine.counting.evidence.visibility import Visibility
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.errors import ConfigError, CountingError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians, harmonics_of

CONFIG = CountConfig(sample_budget=4_000)
SMALL = sim.Setting(fruit=8, clump=3, sheets=0, floaters=8, views=8)
ONCE = settings(
    max_examples=3,
    phases=[Phase.generate],  # shrinking takes minutes and says nothing more
    suppress_health_check=list(HealthCheck),
)


def counted(tree: sim.Simulation, config: CountConfig = CONFIG) -> FruitCount:
    return count_fruit(
        tree.gaussians, tree.probability, tree.cameras, config, label="apple", visibility=tree.visibility
    )


def centers_of(result: FruitCount) -> np.ndarray:
    return np.array([fruit.center for fruit in result.fruits]).reshape(-1, 3)


def f1_of(tree: sim.Simulation, result: FruitCount) -> float:
    diameters = np.array([fruit.diameter for fruit in result.fruits])
    return count_metrics(centers_of(result), diameters, tree.truth).f1


@pytest.fixture(scope="module")
def small() -> sim.Simulation:
    return sim.simulate(SMALL, seed=5)


@pytest.fixture(scope="module")
def small_count(small: sim.Simulation) -> FruitCount:
    return counted(small)


@pytest.mark.parametrize(("setting", "least"), [(sim.CLUMPED, 0.93), (sim.HEAVY, 0.9)])
def test_fruit_of_a_simulated_tree_are_found(setting: sim.Setting, least: float) -> None:
    tree = sim.simulate(dataclasses.replace(setting, fruit=24, sheets=1, floaters=15, views=12), seed=11)
    assert f1_of(tree, counted(tree, CountConfig(sample_budget=10_000))) >= least


def test_diameters_are_within_a_tenth(small: sim.Simulation, small_count: FruitCount) -> None:
    assert small_count.mean_diameter == pytest.approx(small.truth.mean_diameter, rel=0.1)


def test_counting_twice_gives_the_same_fruit(small: sim.Simulation, small_count: FruitCount) -> None:
    np.testing.assert_array_equal(centers_of(counted(small)), centers_of(small_count))


def test_every_fruit_has_members_and_a_visible_fraction(small_count: FruitCount) -> None:
    assert all(len(fruit.members) > 5 for fruit in small_count.fruits)
    assert all(fruit.visible_fraction is not None and 0 < fruit.visible_fraction <= 1 for fruit in small_count.fruits)


def test_every_fruit_says_how_many_views_show_it(small: sim.Simulation, small_count: FruitCount) -> None:
    few = counted(dataclasses.replace(small, cameras=small.cameras[:5]))
    assert 5 < max(fruit.views for fruit in small_count.fruits) <= len(small.cameras)
    assert 1 <= max(fruit.views for fruit in few.fruits) <= 5


def test_every_fruit_has_the_colour_of_its_surface(small: sim.Simulation) -> None:
    red = small.truth.centers[:, 0] > 0
    means = small.gaussians.means.double().numpy()
    owner = np.linalg.norm(means[:, None] - small.truth.centers, axis=2).argmin(axis=1)
    colors = np.where(red[owner][:, None], [0.8, 0.1, 0.1], [0.2, 0.7, 0.1])
    painted = dataclasses.replace(small.gaussians, sh=harmonics_of(colors))
    fruits = counted(dataclasses.replace(small, gaussians=painted)).fruits
    away = [fruit for fruit in fruits if abs(fruit.center[0]) > fruit.diameter]
    assert len(away) > 4
    for fruit in away:
        expected = [204, 26, 26] if fruit.center[0] > 0 else [51, 178, 26]
        assert np.abs(fruit.color.astype(int) - expected).max() <= 12


def test_fruit_are_numbered_from_the_top(small_count: FruitCount) -> None:
    heights = centers_of(small_count)[:, 2]
    assert (np.diff(heights) < 0.02).all()
    assert [fruit.id for fruit in small_count.fruits] == list(range(1, small_count.count + 1))


def test_the_audit_names_every_fruit_once(small_count: FruitCount) -> None:
    own = [id for entry in small_count.audit if "belong to" not in entry.reason for id in entry.fruit_ids]
    assert sorted(own) == [fruit.id for fruit in small_count.fruits]


def test_points_carry_the_ids_of_the_fruit_they_lie_on(small_count: FruitCount) -> None:
    for fruit in small_count.fruits:
        own = small_count.points[small_count.point_fruit_ids == fruit.id]
        assert np.median(np.linalg.norm(own - fruit.center, axis=1)) == pytest.approx(fruit.diameter / 2, rel=0.2)


@ONCE
@given(seed=st.integers(0, 1000))
def test_shuffling_the_gaussians_leaves_the_count_alone(
    small: sim.Simulation, small_count: FruitCount, seed: int
) -> None:
    order = np.random.default_rng(seed).permutation(len(small.gaussians))
    shuffled = dataclasses.replace(
        small,
        gaussians=small.gaussians.select(torch.from_numpy(order)),
        probability=small.probability[order],
        visibility=Visibility(
            small.visibility.weights[order],
            small.visibility.views[order],
            small.visibility.directions[order],
            small.visibility.frame,
        ),
    )
    np.testing.assert_allclose(centers_of(counted(shuffled)), centers_of(small_count), atol=1e-6)


@ONCE
@given(seed=st.integers(0, 1000), shift=st.floats(-50, 50), scale=st.floats(0.01, 100))
def test_moving_turning_and_scaling_the_scene_leaves_the_count_alone(
    small: sim.Simulation, small_count: FruitCount, seed: int, shift: float, scale: float
) -> None:
    turn = Rotation.random(random_state=seed).as_matrix()
    moved = sim.moved_by(small, turn, np.full(3, shift), scale)
    expected = scale * centers_of(small_count) @ turn.T + shift
    found = centers_of(counted(moved))
    assert len(found) == len(expected)
    assert np.abs(found - expected).max() < 0.02 * scale * small.truth.mean_diameter


@pytest.mark.parametrize("scale", [1e-3, 10.0])
def test_a_crown_of_mixed_sizes_is_counted_alike_however_it_is_turned_and_scaled(scale: float) -> None:
    """Many decisions are near a tie in it: what is drawn by chance must turn with the scene."""
    crown = sim.simulate(dataclasses.replace(sim.MIXED, fruit=24, views=12), 6)
    turn = Rotation.random(random_state=1).as_matrix()
    expected = scale * centers_of(counted(crown)) @ turn.T + scale
    found = centers_of(counted(sim.moved_by(crown, turn, np.full(3, scale), scale)))
    assert len(found) == len(expected) > 10
    away = np.linalg.norm(found[:, None] - expected, axis=2).min(axis=0)
    assert away.max() < 0.02 * scale * crown.truth.mean_diameter


@ONCE
@given(seed=st.integers(0, 1000))
def test_a_far_isolated_fruit_adds_exactly_one(small: sim.Simulation, small_count: FruitCount, seed: int) -> None:
    lonely = sim.simulate(sim.Setting(fruit=1, sheets=0, floaters=0, leaves=0, views=8), seed)
    away = np.array([0.0, 0.0, 4.5]) - lonely.truth.centers[0]
    added = dataclasses.replace(
        small,
        gaussians=joined(small.gaussians, sim.moved_by(lonely, np.eye(3), away, 1.0).gaussians),
        probability=np.concatenate([small.probability, lonely.probability]),
        visibility=Visibility(
            np.concatenate([small.visibility.weights, lonely.visibility.weights]),
            np.concatenate([small.visibility.views, lonely.visibility.views]),
            np.concatenate([small.visibility.directions, lonely.visibility.directions]),
            small.visibility.frame,
        ),
    )
    assert counted(added).count == small_count.count + 1


def test_a_prompt_that_nothing_satisfies_is_a_counted_zero(small: sim.Simulation) -> None:
    result = counted(dataclasses.replace(small, probability=np.full(len(small.gaussians), 0.31)))
    assert (result.count, result.max_probability, result.mean_diameter) == (0, 0.31, None)
    assert [entry.verdict for entry in result.audit] == ["dropped"]
    assert "0.310" in result.audit[0].reason


PLACES = (-4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0)


def test_given_trees_of_a_counted_zero_have_no_fruit_each(small: sim.Simulation) -> None:
    nothing = dataclasses.replace(small, probability=np.full(len(small.gaussians), 0.31))
    trees = counted(nothing, dataclasses.replace(CONFIG, tree_places=PLACES)).trees
    assert [(tree.number, tree.count) for tree in trees] == [(1, 0), (2, 0), (3, 0)]
    np.testing.assert_array_equal(np.concatenate([tree.position for tree in trees]), PLACES)


def test_trees_without_fruit_are_a_counted_zero_that_says_so(small: sim.Simulation) -> None:
    nothing = dataclasses.replace(small, probability=np.full(len(small.gaussians), 0.31))
    result = counted(nothing, dataclasses.replace(CONFIG, trees=3))
    assert (result.count, len(result.trees)) == (0, 0)
    assert "no tree of the 3 that --count.trees asks for" in result.audit[-1].reason


@pytest.mark.parametrize(("wanted", "trees"), [({"tree_places": PLACES}, [0, 0, 0]), ({"trees": 3}, [])])
def test_trees_without_fruit_are_reported_like_those_without_points(wanted: dict, trees: list[int]) -> None:
    tree = sim.simulate(sim.Setting(fruit=1, sheets=5, floaters=0, leaves=0, views=8), seed=3)
    on_fruit = np.linalg.norm(tree.gaussians.means.numpy() - tree.truth.centers[0], axis=1) < 0.7
    leaves = dataclasses.replace(tree, probability=np.where(on_fruit, 0.1, tree.probability))
    result = counted(leaves, dataclasses.replace(CONFIG, diameter=1.0, **wanted))
    assert (result.count, [tree.count for tree in result.trees]) == (0, trees)
    assert any("likely a fruit" in entry.reason for entry in result.audit)  # a candidate, nearest to no fruit
    assert ("asks for" in result.audit[-1].reason) == (not trees)


def test_trees_that_stand_above_one_another_are_refused(small: sim.Simulation) -> None:
    above = dataclasses.replace(CONFIG, tree_places=(0.0, 0.0, 0.0, 0.0, 0.0, 2.0))
    with pytest.raises(ConfigError, match="have the same position seen from above"):
        count_fruit(
            small.gaussians, small.probability, small.cameras, above, label="apple", up=np.array([0.0, 0.0, 1.0])
        )


@pytest.mark.parametrize(("sure", "seen"), [(0.5, 1), (0.0, 0)])
def test_a_faint_fruit_counts_if_a_part_of_it_is_certain(sure: float, seen: int) -> None:
    tree = sim.simulate(sim.Setting(fruit=3, sheets=0, floaters=0, leaves=0, views=8), seed=3)
    distance = np.linalg.norm(tree.gaussians.means.numpy() - tree.truth.centers[0], axis=1)
    on_fruit = distance < 0.6 * tree.truth.diameters[0]
    faint = np.where(np.random.default_rng(0).random(len(on_fruit)) < sure, 0.9, 0.2)
    result = counted(dataclasses.replace(tree, probability=np.where(on_fruit, faint, tree.probability)))
    assert result.count == 2 + seen


def test_one_selected_gaussian_is_no_fruit_and_no_failure(small: sim.Simulation) -> None:
    probability = np.zeros(len(small.gaussians))
    probability[0] = 0.9
    result = counted(dataclasses.replace(small, probability=probability))
    assert result.count == 0
    assert len(result.audit) >= 1


def test_a_leaf_sheet_alone_is_no_fruit() -> None:
    tree = sim.simulate(sim.Setting(fruit=1, sheets=5, floaters=0, leaves=0, views=8), seed=3)
    on_fruit = np.linalg.norm(tree.gaussians.means.numpy() - tree.truth.centers[0], axis=1) < 0.7
    result = counted(dataclasses.replace(tree, probability=np.where(on_fruit, 0.1, tree.probability)))
    assert result.count == 0


def test_a_given_diameter_is_used(small: sim.Simulation) -> None:
    result = counted(small, dataclasses.replace(CONFIG, diameter=1.0))
    assert f1_of(small, result) >= 0.85


@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_a_given_diameter_that_is_not_the_scenes_is_reported_and_one_that_is_near_it_is_not(
    small: sim.Simulation, factor: float
) -> None:
    own = small.truth.mean_diameter
    (notice,) = counted(small, dataclasses.replace(CONFIG, diameter=factor * own)).notices
    assert f"{factor * own:.4g} scene units" in notice
    assert not counted(small, dataclasses.replace(CONFIG, diameter=1.2 * own)).notices


@pytest.mark.parametrize("method", ["voting", "template", "fruitnerf"])
def test_a_diameter_in_millimetres_is_an_error_and_no_zero(small: sim.Simulation, method: str) -> None:
    with pytest.raises(CountingError, match=r"--count.diameter 77 is larger than all that may be fruit"):
        counted(small, dataclasses.replace(CONFIG, diameter=77.0, method=method))


def test_fruit_that_are_transparent_are_a_counted_zero_that_says_so(small: sim.Simulation) -> None:
    opacities = torch.full_like(small.gaussians.opacity_logits, -8.0)
    result = counted(
        dataclasses.replace(small, gaussians=dataclasses.replace(small.gaussians, opacity_logits=opacities))
    )
    assert result.count == 0
    assert "are transparent" in result.audit[0].reason
    assert "no Gaussian reaches" not in result.audit[0].reason


@pytest.mark.parametrize("diameter", [None, 1.0])
def test_gaussians_without_a_side_to_the_cameras_are_a_counted_zero_that_says_so(
    small: sim.Simulation, diameter: float | None
) -> None:
    sideless = dataclasses.replace(small.visibility, directions=np.zeros_like(small.visibility.directions))
    result = counted(dataclasses.replace(small, visibility=sideless), dataclasses.replace(CONFIG, diameter=diameter))
    assert result.count == 0
    assert "has a side that faces the cameras" in result.audit[0].reason
    assert "larger" not in result.audit[0].reason


@pytest.mark.parametrize("method", ["voting", "template", "fruitnerf"])
def test_one_gaussian_between_opposite_cameras_is_no_fruit_and_no_failure(method) -> None:
    one = Gaussians(
        torch.zeros(1, 3), torch.full((1, 3), -2.0), torch.tensor([[1.0, 0, 0, 0]]), torch.ones(1), torch.zeros(1, 1, 3)
    )
    cameras = [sim.look_at(np.array([x, 0.0, 0.0]), np.zeros(3)) for x in (-3.0, 3.0)]
    result = count_fruit(one, np.ones(1), cameras, CountConfig(method=method), label="apple")
    assert result.count == 0
    assert "has a side that faces the cameras" in result.audit[0].reason


def test_gaussians_without_extent_are_a_counted_zero(small: sim.Simulation) -> None:
    scales = torch.full_like(small.gaussians.log_scales, -800.0)
    result = counted(dataclasses.replace(small, gaussians=dataclasses.replace(small.gaussians, log_scales=scales)))
    assert result.count == 0
    assert "lie on anything round" in result.audit[0].reason


def test_the_template_method_finds_separate_fruit() -> None:
    tree = sim.simulate(sim.Setting(fruit=10, sheets=0, floaters=0, leaves=0, views=12), seed=2)
    assert f1_of(tree, counted(tree, dataclasses.replace(CONFIG, method="template"))) >= 0.85


def test_a_probability_that_is_no_number_is_refused(small: sim.Simulation) -> None:
    bad = small.probability.copy()
    bad[3] = np.nan
    with pytest.raises(CountingError, match="1 probabilities are not finite"):
        counted(dataclasses.replace(small, probability=bad))


def test_a_mean_that_is_no_number_is_refused(small: sim.Simulation) -> None:
    means = small.gaussians.means.clone()
    means[0, 1] = float("inf")
    with pytest.raises(CountingError, match="means"):
        counted(dataclasses.replace(small, gaussians=dataclasses.replace(small.gaussians, means=means)))


@pytest.mark.parametrize("wrong", [-0.01, 1.01, 97.0])
def test_a_probability_outside_0_and_1_is_refused(small: sim.Simulation, wrong: float) -> None:
    bad = small.probability.copy()
    bad[3] = wrong
    with pytest.raises(CountingError, match=f"{wrong:g}.*not from 0 to 1"):
        counted(dataclasses.replace(small, probability=bad))


def test_a_probability_that_rounding_takes_above_1_counts(small: sim.Simulation) -> None:
    above = np.full(len(small.gaussians), 1e-6)
    above[0] = 1.0 + 1e-6
    assert counted(dataclasses.replace(small, probability=above)).count == 0


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_colour_that_is_no_number_is_refused(small: sim.Simulation, value: float) -> None:
    sh = small.gaussians.sh.clone()
    sh[5, 0, 1] = value
    with pytest.raises(CountingError, match="1 values of the Gaussians' sh are not finite"):
        counted(dataclasses.replace(small, gaussians=dataclasses.replace(small.gaussians, sh=sh)))


@pytest.mark.parametrize("up", [[0.0, 0.0, 0.0], [0.0, np.nan, 1.0], [0.0, 0.0, np.inf], [0.0, 1.0]])
def test_a_direction_up_that_is_none_is_refused(small: sim.Simulation, up: list[float]) -> None:
    with pytest.raises(CountingError, match="The direction up is"):
        count_fruit(small.gaussians, small.probability, small.cameras, CONFIG, label="apple", up=np.array(up))


def test_gaussians_that_all_lie_in_one_place_are_refused(small: sim.Simulation) -> None:
    means = torch.ones_like(small.gaussians.means)
    with pytest.raises(CountingError, match=rf"All {len(means)} Gaussians lie at the same position, 1 1 1. Train"):
        counted(dataclasses.replace(small, gaussians=dataclasses.replace(small.gaussians, means=means)))


def test_a_probability_of_another_length_is_refused(small: sim.Simulation) -> None:
    with pytest.raises(CountingError, match="shape"):
        counted(dataclasses.replace(small, probability=small.probability[:-1]))


def test_no_gaussians_and_no_cameras_are_refused(small: sim.Simulation) -> None:
    none = small.gaussians.select(torch.zeros(0, dtype=torch.long))
    with pytest.raises(CountingError, match="no Gaussians"):
        counted(dataclasses.replace(small, gaussians=none, probability=np.zeros(0)))
    with pytest.raises(CountingError, match="There are no cameras"):
        counted(dataclasses.replace(small, cameras=[]))


def joined(first: Gaussians, second: Gaussians) -> Gaussians:
    pairs = {name: torch.cat([getattr(first, name), getattr(second, name)]) for name in PARAMETERS}
    return Gaussians(**pairs)


def test_no_deviation_of_a_diameter_is_below_what_the_spread_of_sizes_allows(small_count: FruitCount) -> None:
    told = np.array([fruit.diameter_sd / fruit.diameter for fruit in small_count.fruits])
    assert told.min() > UNTOLD * SPREADS[0]
