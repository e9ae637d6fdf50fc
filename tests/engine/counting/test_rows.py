"""Long rows: estimates do not depend on how many trees stand in a row, or where it leads."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import simulated_row as sim
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from fruitlangs.engine.counting.evidence.cluster import Search
from fruitlangs.engine.counting.evidence.size import FruitSize
from fruitlangs.engine.counting.regions.crown import (
    PLACES,
    estimate_hidden_share,
    sample_crowns,
    sample_hull,
    split_row,
)
from fruitlangs.engine.counting.regions.ground import NEARNESS, doubt_sunken, find_fallen, find_sites

EVERY_ROW = [(trees, direction) for trees in (6, 20, 40) for direction in sim.DIRECTIONS] + [(100, "diagonal")]


def hanging(row: sim.Row) -> np.ndarray:
    return row.centers[~row.fallen]


def told(row: sim.Row) -> list[bool | None]:
    """Whether each fruit lies on the ground."""
    diameters = np.full(len(row.centers), sim.DIAMETER)
    return find_fallen(row.gaussians, row.cameras, row.centers, diameters, row.up)


@pytest.mark.parametrize(("trees", "direction"), EVERY_ROW)
def test_the_crowns_of_every_row_are_judged_from_as_many_places(trees: int, direction: str) -> None:
    crowns = split_row(hanging(sim.simulate_row(trees, direction)))
    places = sample_crowns(crowns, seed=0)
    assert len(crowns) == trees
    assert PLACES <= sum(map(len, places)) <= PLACES + trees
    assert min(map(len, places)) >= 0.9 * PLACES / trees


@pytest.mark.parametrize(("trees", "direction"), EVERY_ROW)
def test_fruit_of_every_row_hang_and_lie_as_they_do(trees: int, direction: str) -> None:
    row = sim.simulate_row(trees, direction)
    right = np.array([low is not None and low == fallen for low, fallen in zip(told(row), row.fallen, strict=True)])
    assert right[row.fallen].mean() > 0.99
    assert right[~row.fallen].mean() > 0.99


def test_gaps_between_trees_do_not_count_as_crown() -> None:
    row = sim.simulate_row(8, "diagonal")
    fruit, pictures = hanging(row), row.pictures
    alone = [
        estimate_hidden_share(own, pictures, 0.5 * sim.DIAMETER, seed=0)
        for own in np.split(fruit, len(fruit) // sim.FRUIT)
    ]
    assert estimate_hidden_share(fruit, pictures, 0.5 * sim.DIAMETER, seed=0) == pytest.approx(np.mean(alone), abs=0.03)
    assert np.mean(alone) > 0.2


@pytest.mark.parametrize("fruit", [10, 40])
def test_trees_far_apart_are_one_crown_each_however_few_fruit_they_bear(
    fruit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sim, "SPACING", 4.0)
    monkeypatch.setattr(sim, "FRUIT", fruit)
    crowns = split_row(hanging(sim.simulate_row(12, "diagonal")))
    assert [len(crown) for crown in crowns] == [fruit] * 12


def test_a_row_whose_crowns_touch_is_cut_into_parts_as_long_as_it_is_wide() -> None:
    row = np.random.default_rng(0).uniform([0.0, 0.0, 0.0], [20.0, 1.0, 2.0], (4000, 3))
    crowns = split_row(row)
    assert sum(map(len, crowns)) == len(row)
    assert all(1.2 < np.ptp(crown[:, 0]) < 3.0 for crown in crowns)


def test_a_slender_tree_is_one_crown() -> None:
    tree = np.random.default_rng(0).uniform([0.0, 0.0, 0.0], [1.0, 1.2, 3.0], (60, 3))
    assert [len(crown) for crown in split_row(tree)] == [60]


def test_fruit_at_one_place_and_without_a_hull_hide_nothing() -> None:
    pictures = sim.simulate_row(1).pictures
    for fruit in (
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.zeros((9, 3)),
        np.random.default_rng(0).random((30, 3)) * [1.0, 1.0, 0.0],
    ):
        assert estimate_hidden_share(fruit, pictures, 0.04, seed=0) == 0.0


def test_places_are_spread_evenly_over_the_hull() -> None:
    box = np.array([[x, y, z] for x in (0.0, 4.0) for y in (0.0, 2.0) for z in (0.0, 1.0)])
    ends = np.concatenate([box, np.random.default_rng(0).uniform(0.0, 1.0, (30, 3)) * [4.0, 2.0, 1.0]])
    places = sample_hull(ends, 20_000, np.random.default_rng(1))
    counted, _ = np.histogramdd(places, bins=(4, 2, 2), range=((0.0, 4.0), (0.0, 2.0), (0.0, 1.0)))
    assert counted.sum() == 20_000
    assert np.abs(counted / (20_000 / 16) - 1.0).max() < 0.12


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100.0))
def test_places_move_with_the_fruit(seed: int, scale: float) -> None:
    fruit = np.random.default_rng(seed).normal(size=(50, 3)) * [8.0, 1.0, 1.0]
    turn, shift = Rotation.random(random_state=seed).as_matrix(), np.array([3.0, -2.0, 1.0])
    moved = scale * fruit @ turn.T + shift
    order = np.random.default_rng(seed).permutation(len(fruit))
    here, there = (sample_crowns(split_row(each), seed=0) for each in (fruit, moved[order]))
    np.testing.assert_allclose(np.concatenate(there), scale * np.concatenate(here) @ turn.T + shift, atol=1e-6 * scale)


@pytest.mark.parametrize("direction", sim.DIRECTIONS)
def test_hidden_crown_is_the_same_wherever_a_row_leads(direction: str) -> None:
    here, there = (sim.simulate_row(6, each, sim.level) for each in ("x", direction))
    shares = [estimate_hidden_share(hanging(row), row.pictures, 0.5 * sim.DIAMETER, seed=0) for row in (here, there)]
    assert shares[0] == pytest.approx(shares[1], abs=0.01)


@pytest.mark.parametrize("trees", [1, 3])
def test_a_short_row_is_one_site_as_large_as_its_cameras_are_far(trees: int) -> None:
    row = sim.simulate_row(trees)
    sites = find_sites(row.centers, np.ones(len(row.centers), bool), row.cameras)
    away = np.linalg.norm([camera.center - np.median(row.centers, axis=0) for camera in row.cameras], axis=1)
    assert len(sites) == 1
    assert sites[0].fruit.tolist() == list(range(len(row.centers)))
    assert sites[0].subject.radius == NEARNESS * np.median(away)


def test_sites_of_a_long_row_are_as_large_as_those_of_a_tree_and_hold_every_fruit_once() -> None:
    row = sim.simulate_row(40, "slope")
    sites = find_sites(row.centers, ~row.fallen, row.cameras)
    assert sorted(np.concatenate([site.fruit for site in sites]).tolist()) == list(range(len(row.centers)))
    assert all(0.5 * sim.AWAY * NEARNESS < site.subject.radius < 2.0 * sim.AWAY * NEARNESS for site in sites)


def test_a_tree_with_few_fruit_far_away_is_a_site_of_its_own_if_cameras_stand_at_it() -> None:
    tree, other = sim.simulate_row(2), sim.simulate_row(1)
    shift = 200.0 * sim.DIRECTIONS["y"]
    centers = np.concatenate([tree.centers, other.centers[:9] + shift])
    there = [replace(camera, world_to_camera=moved(camera.world_to_camera, shift)) for camera in other.cameras]
    everything = np.ones(len(centers), bool)
    alone = find_sites(centers, everything, tree.cameras)
    both = find_sites(centers, everything, tree.cameras + there)
    assert [len(site.fruit) for site in alone] == [len(centers)]
    assert sorted(len(site.fruit) for site in both) == [9, len(tree.centers)]


def moved(pose: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """The world-to-camera matrix of a camera that stands elsewhere."""
    return np.vstack([np.column_stack([pose[:3, :3], pose[:3, 3] - pose[:3, :3] @ shift]), [[0.0, 0.0, 0.0, 1.0]]])


def test_what_is_no_ground_at_one_end_of_a_row_leaves_the_other_end_alone() -> None:
    row = sim.simulate_row(12)
    below = row.centers[:30] - 2.0 * row.up
    everything = np.concatenate([row.centers, below])
    lying = find_fallen(row.gaussians, row.cameras, everything, np.full(len(everything), sim.DIAMETER), row.up)[
        : len(row.centers)
    ]
    near = row.centers @ sim.DIRECTIONS["x"] < 2.0 * sim.SPACING
    far = row.centers @ sim.DIRECTIONS["x"] > 8.0 * sim.SPACING
    assert [lying[index] for index in np.flatnonzero(near)] == [None] * int(near.sum())
    assert [lying[index] for index in np.flatnonzero(far)] == row.fallen[far].tolist()


def test_candidates_in_the_ground_of_a_hilly_row_are_doubted_and_no_others() -> None:
    row = sim.simulate_row(40, "slope")
    buried = row.centers[row.fallen] - 0.5 * sim.DIAMETER * row.up
    centers = np.concatenate([row.centers, buried])
    candidates = SimpleNamespace(spheres=SimpleNamespace(centers=centers))
    probabilities = np.where(np.arange(len(centers)) < len(hanging(row)), 0.99, 0.7)
    found = Search(None, FruitSize(sim.DIAMETER, 0.1), candidates, {}, probabilities)
    doubted = doubt_sunken(found, row.gaussians, row.cameras, row.up).probabilities < probabilities
    assert doubted[: len(row.centers)].mean() < 0.01
    assert doubted[len(row.centers) :].mean() > 0.95
