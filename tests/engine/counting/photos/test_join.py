"""Fruit that no Gaussian matches and photos show."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import simulated_fruit as sim
from numpy.typing import NDArray

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.visibility import draw
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.evaluation.metrics import count_metrics

CONFIG = CountConfig(sample_budget=20_000)
SETTING = sim.Setting(fruit=12, clump=2, sheets=0, floaters=4, views=16)
LEFT_OUT = 3

Maps = list[NDArray[np.float32]]


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(SETTING, seed=3)


@pytest.fixture(scope="module")
def maps(tree: sim.Simulation) -> Maps:
    """What photos of the whole tree show."""
    return [picture.fruit for picture in draw(tree.gaussians, np.asarray(tree.probability, np.float64), tree.cameras)]


@pytest.fixture(scope="module")
def without(tree: sim.Simulation) -> sim.Simulation:
    """The tree with some fruit whose Gaussians do not match the prompt."""
    means, probability = tree.gaussians.means.numpy(), np.array(tree.probability)
    for center, diameter in zip(tree.truth.centers[:LEFT_OUT], tree.truth.diameters[:LEFT_OUT], strict=True):
        probability[np.linalg.norm(means - center, axis=1) < 0.7 * diameter] = 0.0
    return dataclasses.replace(tree, probability=probability)


def counted(tree: sim.Simulation, photos: Maps | None) -> FruitCount:
    return count_fruit(tree.gaussians, tree.probability, tree.cameras, CONFIG, label="apple", photos=photos)


def recall(tree: sim.Simulation, found: FruitCount) -> float:
    return count_metrics(found.centers, found.diameters, tree.truth).recall


def test_fruit_that_no_gaussian_matches_are_found_in_photos(without: sim.Simulation, maps: Maps) -> None:
    alone, together = counted(without, None), counted(without, maps)
    assert recall(without, alone) <= 1.0 - LEFT_OUT / SETTING.fruit
    assert recall(without, together) > recall(without, alone)
    assert any("seen in the photos only" in entry.reason for entry in together.audit)


def test_photos_of_a_whole_tree_change_nothing(tree: sim.Simulation, maps: Maps) -> None:
    assert abs(counted(tree, maps).count - counted(tree, None).count) <= 1


def test_photos_that_show_no_fruit_add_none(tree: sim.Simulation, maps: Maps) -> None:
    empty = [np.zeros_like(each) for each in maps]
    assert counted(tree, empty).count <= counted(tree, None).count


def test_equal_photos_give_equal_counts(without: sim.Simulation, maps: Maps) -> None:
    one, other = counted(without, maps), counted(without, maps)
    assert np.array_equal(one.centers, other.centers)
    assert [fruit.probability for fruit in one.fruits] == [fruit.probability for fruit in other.fruits]
