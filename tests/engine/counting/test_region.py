"""Counting in a part of the scene: which points it holds, and that fruit in it are those of the whole count."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import simulated_fruit as sim
from hypothesis import given, settings
from hypothesis import strategies as st

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.surface_points import SurfacePoints
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.counting.geometry.random_streams import even_turns
from fruitlangs.engine.counting.geometry.sphere import unit_directions
from fruitlangs.engine.counting.published.template import split_by_template
from fruitlangs.engine.counting.regions.region import Box, Prism, keep_inside, region_of
from fruitlangs.engine.errors import ConfigError, CountingError

UP = np.array([0.0, 0.0, 1.0])
CONFIG = CountConfig(sample_budget=5_000)
HOOK = np.array([[0.0, 0, 5], [4, 0, 5], [4, 4, 7], [3, 4, 5], [3, 1, 5], [0, 1, 5]])
"""The outline of an L, its corners at several heights."""
FAR = 99.0


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(sim.Setting(fruit=10, clump=2, sheets=0, floaters=8, views=8), seed=8)


@pytest.fixture(scope="module")
def whole(tree: sim.Simulation) -> FruitCount:
    return counted(tree, CONFIG)


def counted(tree: sim.Simulation, config: CountConfig) -> FruitCount:
    return count_fruit(
        tree.gaussians, tree.probability, tree.cameras, config, label="apple", up=UP, visibility=tree.visibility
    )


def boxed(low: float, high: float) -> CountConfig:
    """Counting between two values of x."""
    return dataclasses.replace(CONFIG, box=(low, -FAR, -FAR, high, FAR, FAR))


def outlined(corners: np.ndarray) -> CountConfig:
    return dataclasses.replace(CONFIG, polygon=tuple(corners.ravel().tolist()))


@pytest.mark.parametrize(("diameter", "near"), [(1.0, 0.02), (None, 0.05)])
def test_fruit_in_a_region_are_those_of_the_whole_count_also_where_its_border_cuts_one(
    tree: sim.Simulation, whole: FruitCount, diameter: float | None, near: float
) -> None:
    border = float(np.sort(whole.centers[:, 0])[4]) - 0.1  # a fruit of diameter 1 lies on both sides
    every = whole if diameter is None else counted(tree, dataclasses.replace(CONFIG, diameter=diameter))
    expected = every.centers[every.centers[:, 0] >= border]
    found = counted(tree, dataclasses.replace(boxed(border, FAR), diameter=diameter)).centers
    assert len(found) == len(expected) >= 3
    assert np.linalg.norm(found[:, None] - expected, axis=2).min(axis=0).max() < near


def test_two_halves_hold_every_fruit_once(tree: sim.Simulation, whole: FruitCount) -> None:
    border = float(np.sort(whole.centers[:, 0])[5]) + 0.2
    left, right = counted(tree, boxed(-FAR, border)), counted(tree, boxed(border, FAR))
    assert left.count > 0
    assert right.count > 0
    assert left.count + right.count == whole.count


def test_a_square_outline_counts_as_a_box_of_any_height(tree: sim.Simulation) -> None:
    square = np.array([[0.3, -50, 0], [50, -50, 3], [50, 50, 0], [0.3, 50, 0]])
    np.testing.assert_array_equal(counted(tree, outlined(square)).centers, counted(tree, boxed(0.3, 50.0)).centers)


def test_the_audit_says_how_many_fruit_at_the_border_lie_outside(tree: sim.Simulation, whole: FruitCount) -> None:
    border = float(np.sort(whole.centers[:, 0])[5]) - 0.1
    part = counted(tree, boxed(border, FAR))
    (entry,) = [entry for entry in part.audit if "outside" in entry.reason]
    beyond = int(entry.reason.split()[0])
    assert (entry.verdict, entry.fruit_ids) == ("dropped", ())
    assert 1 <= beyond <= whole.count - part.count
    own = [number for each in part.audit if "belong to" not in each.reason for number in each.fruit_ids]
    assert sorted(own) == [fruit.id for fruit in part.fruits]


def test_a_region_next_to_a_fruits_centre_holds_none_of_it(tree: sim.Simulation, whole: FruitCount) -> None:
    rightmost = whole.fruits[int(whole.centers[:, 0].argmax())]
    result = counted(tree, dataclasses.replace(boxed(rightmost.center[0] + 0.2, FAR), diameter=1.0))
    assert result.count == 0
    assert any("outside and are not counted" in entry.reason for entry in result.audit)


def test_a_region_that_holds_everything_changes_nothing(tree: sim.Simulation, whole: FruitCount) -> None:
    result = counted(tree, boxed(-FAR, FAR))
    np.testing.assert_array_equal(result.centers, whole.centers)
    assert result.audit == whole.audit


def test_reasons_of_clusters_and_small_fruit_go_with_them_into_a_region() -> None:
    clusters = split_by_template(sampled(), 1.0)
    clusters = dataclasses.replace(clusters, small=frozenset({2}))
    assert [clusters.findings[number][:14] for number in range(3)] == ["a single fruit"] * 3
    told = {tuple(center): number for number, center in enumerate(clusters.spheres.centers)}
    box = Box(np.array([2.5, -9.0, -9.0]), np.array([9.0, 9.0, 9.0]))  # without the first of three in a row
    kept = keep_inside(clusters, box)
    before = [told[tuple(center)] for center in kept.spheres.centers]
    assert len(before) == 2
    assert [number in kept.small for number in range(2)] == [number == 2 for number in before]
    homes = [int(kept.components[kept.owners == number][0]) for number in range(2)]
    old = [int(clusters.components[clusters.owners == number][0]) for number in before]
    assert [kept.findings[home] for home in homes] == [clusters.findings[home] for home in old]
    assert set(kept.findings) == set(homes)


def sampled() -> SurfacePoints:
    """Three balls of diameter 1 in a row, 3 apart, each seen from all around."""
    directions = unit_directions(1500)
    places = np.concatenate([0.5 * directions + [3.0 * number, 0.0, 0.0] for number in range(3)])
    normals = np.tile(directions, (3, 1))
    return SurfacePoints(
        places, normals, np.arange(len(places)), np.ones(len(places)), normals, even_turns(len(places))
    )


def test_a_region_without_gaussians_is_an_error_that_says_where_the_scene_is(tree: sim.Simulation) -> None:
    with pytest.raises(CountingError, match=r"detail lies between -\d.* and \d"):
        counted(tree, boxed(50.0, 60.0))


def test_a_region_without_the_prompts_gaussians_is_a_counted_zero(tree: sim.Simulation) -> None:
    right = tree.gaussians.means.numpy()[:, 0] > 0
    result = counted(dataclasses.replace(tree, probability=np.where(right, 0.1, tree.probability)), boxed(0.0, FAR))
    assert (result.count, result.max_probability) == (0, 0.1)


def test_an_outline_holds_what_lies_over_and_under_it() -> None:
    points = np.array([[1, 0.5, -80], [3.5, 3.5, 80], [1, 3, 5], [-0.5, 0.5, 5], [3.5, 4.2, 5]])
    assert Prism.over(HOOK, UP).contains(points).tolist() == [True, True, False, False, False]


def test_a_margin_takes_in_what_is_no_farther_outside() -> None:
    points = np.array([[1.0, 1.4, 0], [1, 1.6, 0], [-0.3, -0.3, 0], [-0.4, -0.4, 0]])
    assert Prism.over(HOOK, UP).contains(points, 0.5).tolist() == [True, False, True, False]
    box = region_of(CountConfig(box=(1, 1, 1, 0, 0, 0)), UP)
    assert box.contains(np.array([[1.4, 0, 0], [1.6, 0, 0]]), 0.5).tolist() == [True, False]


@settings(max_examples=20)
@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100), shift=st.floats(-50, 50))
def test_moving_turning_and_scaling_an_outline_moves_what_it_holds(seed: int, scale: float, shift: float) -> None:
    random = np.random.default_rng(seed)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    points = random.uniform(-1, 5, (50, 3))
    moved = Prism.over(scale * HOOK @ turn.T + shift, turn @ UP)
    np.testing.assert_array_equal(
        moved.contains(scale * points @ turn.T + shift, 0.3 * scale), Prism.over(HOOK, UP).contains(points, 0.3)
    )


def test_an_outline_may_end_where_it_began() -> None:
    assert Prism.over(np.vstack([HOOK, HOOK[:1]]), UP).area == pytest.approx(Prism.over(HOOK, UP).area)


@pytest.mark.parametrize(
    ("corners", "problem"),
    [
        ([[0, 0, 0], [1, 1, 0], [2, 2, 0]], "no area"),
        ([[0, 0, 0], [1, 0, 0], [1, 0, 5]], "no area"),
        ([[0, 0, 0], [0, 0, 0], [0, 0, 0]], "no area"),
        ([[0, 0, 0], [2, 1, 0], [2, 0, 0], [0, 2, 0]], "crosses itself"),
        ([[0, 0, 0], [2, 0, 0], [2, 2, 0], [1, 0, 0], [0, 2, 0]], "crosses itself"),
    ],
)
def test_an_outline_that_is_none_is_an_error(corners: list[list[float]], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        region_of(outlined(np.array(corners, float)), UP)


@pytest.mark.parametrize(
    ("given", "problem"),
    [
        ({"box": (0, 0, 0, 1, 1)}, "--count.box is 0 0 0 1 1. Use two opposite corners"),
        ({"box": (0, 0, 0, 1, 1, float("nan"))}, "--count.box is 0 0 0 1 1 nan. Use two opposite corners"),
        ({"box": (0, 0, 0, 1, 0, 1)}, "--count.box 0 0 0 1 0 1 has no volume"),
        ({"polygon": (0, 0, 0, 1, 1, 1)}, "--count.polygon is 0 0 0 1 1 1. Use three or more corners"),
        ({"polygon": tuple(range(10))}, "--count.polygon is 0 1 2 3 4 5 6 7 8 9. Use three or more corners"),
        ({"polygon": ("0", "b", "0")}, "--count.polygon is 0 b 0. Use three or more corners"),
        ({"box": (0, 0, 0, 1, 1, 1), "polygon": tuple(range(9))}, "both given"),
        ({"heights": (0, 1)}, "--count.heights needs --count.polygon"),
        ({"polygon": tuple(range(9)), "heights": (1, 1)}, "Use two different finite numbers"),
        ({"tree_places": (1, 2)}, "--count.tree-places is 1 2. Use x y z of each tree"),
        ({"tree_places": (1, 2, 3, 1, 2, 3)}, "the same position twice"),
        ({"tree_places": (1, 2, 3), "trees": 2}, "--count.trees is 2 and --count.tree-places has 1 trees"),
    ],
)
def test_numbers_that_are_no_places_are_an_error_that_names_the_flag(given: dict[str, object], problem: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(problem)):
        CountConfig(**given)


def test_places_that_come_from_json_or_text_are_the_same_settings() -> None:
    expected = CountConfig(polygon=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0))
    assert CountConfig(polygon=[0, 0, 0, 1, 0, 0, 1, 1, 0]) == expected
    assert CountConfig(polygon=tuple("000100110")) == expected
    assert CountConfig(polygon=[0, 0, 0, 1, 0, 0, 1, 1, 0], heights=[2, 1]).heights == (1.0, 2.0)


def test_an_outline_with_heights_holds_what_lies_between_them_along_up() -> None:
    up = np.array([0.0, -0.8, 0.6])
    outline = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 3, 4], [-1, 3, 4]])
    region = region_of(CountConfig(polygon=tuple(outline.ravel()), heights=(2.0, 1.0)), up)
    middle = outline.mean(axis=0)
    level = middle - (middle @ up) * up
    heights = np.array([0.4, 0.9, 1.01, 1.5, 1.99, 2.1])
    points = level + heights[:, None] * up
    assert region.contains(points).tolist() == [False, False, True, True, True, False]
    assert region.contains(points, 0.2).tolist() == [False, True, True, True, True, True]
