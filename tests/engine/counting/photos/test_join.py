"""Fruit that no Gaussian matches and photos show."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import simulated_fruit as sim
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.cluster import Search
from fruitlangs.engine.counting.evidence.visibility import Picture, draw
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.counting.photos import join
from fruitlangs.engine.counting.photos.join import join_places, measure_dissent
from fruitlangs.engine.counting.photos.search import FoundInPhotos
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians

CONFIG = CountConfig(sample_budget=20_000)
SETTING = sim.Setting(fruit=12, clump=2, sheets=0, floaters=4, views=16)
LEFT_OUT = 3

Maps = list[PhotoMap]


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(SETTING, seed=3)


@pytest.fixture(scope="module")
def maps(tree: sim.Simulation) -> Maps:
    """What photos of the whole tree show."""
    pictures = draw(tree.gaussians, np.asarray(tree.probability, np.float64), tree.cameras)
    return [PhotoMap(picture.fruit, offsets_of(tree, picture)) for picture in pictures]


def offsets_of(tree: sim.Simulation, picture: Picture) -> NDArray[np.float32]:
    """Where each pixel lies on the true fruit nearest to the surface that it shows."""
    camera, (height, width) = picture.camera, picture.depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    focal, middle = np.diag(camera.K)[:2], camera.K[:2, 2]
    rays = np.concatenate([(np.stack([u, v], axis=-1) - middle) / focal, np.ones((height, width, 1))], axis=-1)
    pose = camera.world_to_camera[:3]
    places = tree.truth.centers @ pose[:, :3].T + pose[:, 3]
    nearest = cKDTree(places).query((rays * picture.depth[..., None]).reshape(-1, 3))[1].reshape(height, width)
    centers, radii = places[:, :2] / places[:, 2:] * focal + middle, focal[0] * tree.truth.diameters / 2 / places[:, 2]
    offsets = (np.stack([u, v], axis=-1) - centers[nearest]) / radii[nearest][..., None]
    return offsets.astype(np.float32)


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


@pytest.fixture(scope="module")
def joints(without: sim.Simulation, maps: Maps) -> tuple[Search, tuple[FoundInPhotos, FruitCount]]:
    """The search with photos, what was found in them, and the count."""
    photos, searches = list[FoundInPhotos](), list[Search]()

    def recorded(found: Search, seen: FoundInPhotos, *given: Any) -> Search:
        photos.append(seen)
        searches.append(join_places(found, seen, *given))
        return searches[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(join, "join_places", recorded)
        counts = counted(without, maps)
    return searches[-1], (photos[-1], counts)


@pytest.fixture
def both(joints: tuple[Search, tuple[FoundInPhotos, FruitCount]]) -> tuple[FoundInPhotos, FruitCount]:
    return joints[1]


def test_the_search_goes_on_with_the_diameter_that_photos_tell(
    joints: tuple[Search, tuple[FoundInPhotos, FruitCount]],
) -> None:
    assert joints[0].size.diameter == joints[1][0].diameter


def test_fruit_have_the_centres_and_diameters_that_photos_tell(both: tuple[FoundInPhotos, FruitCount]) -> None:
    photos, found = both
    likely = photos.places.select(photos.log_odds > 0.0)
    nearest = cKDTree(likely.centers).query(found.centers)[1]
    assert np.array_equal(found.centers, likely.centers[nearest])
    assert np.array_equal(found.diameters, 2.0 * likely.radii[nearest])
    assert len(np.unique(found.diameters)) == found.count > LEFT_OUT


def test_the_deviation_of_a_diameter_is_that_of_its_measurement_in_photos(
    both: tuple[FoundInPhotos, FruitCount],
) -> None:
    photos, found = both
    said = photos.radius_sds[cKDTree(photos.places.centers).query(found.centers)[1]]
    sds = np.array([fruit.diameter_sd / fruit.diameter for fruit in found.fruits])
    assert sds == pytest.approx(said, rel=0.2)
    assert (sds < 0.2).all()


def test_the_size_of_the_scene_is_that_of_the_photos(without: sim.Simulation, maps: Maps) -> None:
    """Those of Gaussians, here given as too small, are measured again."""
    config = dataclasses.replace(CONFIG, diameter=0.8)
    found = count_fruit(without.gaussians, without.probability, without.cameras, config, label="apple", photos=maps)
    true = without.truth.diameters[cKDTree(without.truth.centers).query(found.centers)[1]]
    assert np.median(found.diameters / true) == pytest.approx(1.0, abs=0.12)


def test_photos_of_a_whole_tree_change_nothing(tree: sim.Simulation, maps: Maps) -> None:
    assert abs(counted(tree, maps).count - counted(tree, None).count) <= 1


def test_photos_that_show_no_fruit_add_none(tree: sim.Simulation, maps: Maps) -> None:
    empty = [PhotoMap(np.zeros_like(each.probability), each.offsets) for each in maps]
    assert counted(tree, empty).count <= counted(tree, None).count


def test_equal_photos_give_equal_counts(without: sim.Simulation, maps: Maps) -> None:
    one, other = counted(without, maps), counted(without, maps)
    assert np.array_equal(one.centers, other.centers)
    assert [fruit.probability for fruit in one.fruits] == [fruit.probability for fruit in other.fruits]


def shown(maps: Maps, probability: float) -> Maps:
    """The maps with one probability everywhere."""
    return [PhotoMap(np.full_like(each.probability, probability), each.offsets) for each in maps]


def test_masks_that_say_fruit_everywhere_add_no_fruit_to_gaussians_that_are_right(
    tree: sim.Simulation, maps: Maps
) -> None:
    assert abs(counted(tree, shown(maps, 1.0)).count - SETTING.fruit) <= 1


def test_masks_and_gaussians_that_say_fruit_everywhere_are_no_confident_count(tree: sim.Simulation, maps: Maps) -> None:
    everything = dataclasses.replace(tree, probability=np.ones(len(tree.gaussians)))
    found = counted(everything, shown(maps, 1.0))
    assert found.interval is not None
    low, high = found.interval
    assert low <= SETTING.fruit <= high
    assert found.count > 0 or high > 2 * SETTING.fruit


def test_masks_that_say_fruit_nowhere_are_no_confident_count(tree: sim.Simulation, maps: Maps) -> None:
    found = counted(tree, shown(maps, 0.0))
    assert found.interval is not None
    assert found.interval[0] <= SETTING.fruit <= found.interval[1]
    assert any("surfaces of the Gaussians look like apple" in notice for notice in found.notices)


def test_photos_dissent_by_the_fruit_that_they_refuse_beyond_what_is_usual() -> None:
    assert measure_dissent(100.0, 130.0) == 0.0
    assert measure_dissent(105.5, 100.0) == 0.0
    assert measure_dissent(199.5, 99.5) == pytest.approx(np.log(2.0) - 0.06)
    assert measure_dissent(0.0, 0.0) == 0.0


def test_masks_of_other_views_make_the_interval_wider(tree: sim.Simulation, maps: Maps) -> None:
    right, wrong = counted(tree, maps).interval, counted(tree, [*maps[5:], *maps[:5]]).interval
    assert right is not None
    assert wrong is not None
    assert wrong[0] <= SETTING.fruit <= wrong[1]
    assert wrong[1] - wrong[0] > right[1] - right[0]


def test_moving_and_scaling_the_scene_leaves_a_count_with_photos_alone(without: sim.Simulation, maps: Maps) -> None:
    turn, shift, scale = Rotation.random(random_state=2).as_matrix(), np.array([3.0, -2.0, 5.0]), 7.0
    here, there = counted(without, maps), counted(sim.moved_by(without, turn, shift, scale), maps)
    assert here.count == there.count
    expected = scale * here.centers @ turn.T + shift
    away = np.linalg.norm(there.centers[:, None] - expected, axis=2).min(axis=0)
    assert away.max() < 0.05 * scale * without.truth.mean_diameter


def test_shuffling_the_gaussians_leaves_a_count_with_photos_alone(without: sim.Simulation, maps: Maps) -> None:
    order = np.random.default_rng(1).permutation(len(without.gaussians))
    shuffled = dataclasses.replace(
        without, gaussians=without.gaussians.select(torch.from_numpy(order)), probability=without.probability[order]
    )
    here, there = counted(without, maps), counted(shuffled, maps)
    np.testing.assert_allclose(here.centers, there.centers, atol=1e-4)


def test_two_trees_far_apart_have_the_fruit_that_each_has_alone(tree: sim.Simulation, maps: Maps) -> None:
    """The second tree has fewer photos than the first."""
    config = dataclasses.replace(CONFIG, diameter=1.0)
    shift = np.array([300.0, 200.0, 0.0])
    moved = sim.moved_by(tree, np.eye(3), shift, 1.0)
    few = dataclasses.replace(moved, cameras=moved.cameras[::2])
    pair = Gaussians(*(
        torch.cat([getattr(each.gaussians, name) for each in (tree, few)]) for name in PARAMETERS
    ))  # fmt: skip
    probability = np.tile(tree.probability, 2)
    cameras, photos = [*tree.cameras, *few.cameras], [*maps, *maps[::2]]
    together = count_fruit(pair, probability, cameras, config, label="apple", photos=photos)
    alone = [
        count_fruit(each.gaussians, each.probability, each.cameras, config, label="apple", photos=shown)
        for each, shown in ((tree, maps), (few, maps[::2]))
    ]
    expected = np.concatenate([each.centers for each in alone])
    assert together.count == len(expected)
    assert cKDTree(together.centers).query(expected)[0].max() < 0.05
    assert together.total == pytest.approx(sum(each.total or 0.0 for each in alone), rel=0.05)
