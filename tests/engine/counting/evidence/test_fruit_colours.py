"""Fruit of one colour among all that were found."""

from __future__ import annotations

import numpy as np
import pytest
import simulated_fruit as sim
import torch
from numpy.typing import NDArray

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.counting.evidence.fruit_colours import FruitColours, _add_pixels
from fruitlangs.engine.counting.evidence.visibility import Picture, draw
from fruitlangs.engine.counting.fruit import FruitCount
from fruitlangs.engine.language.encoders.encoder import ColourSplit
from fruitlangs.engine.language.features.photo_features import PhotoFeatures
from fruitlangs.engine.language.prompts.colour_choice import ColourChoice
from fruitlangs.engine.language.prompts.photo_probability import PhotoMap
from fruitlangs.engine.report.words import explain_nothing_found
from fruitlangs.engine.scene.camera import Camera

CONFIG = CountConfig(sample_budget=4_000)
WORDS = ("red", "green", "blue")


@pytest.fixture(scope="module")
def tree() -> sim.Simulation:
    return sim.simulate(sim.Setting(fruit=8, clump=3, sheets=0, floaters=8, views=8), seed=5)


def owners_of(tree: sim.Simulation) -> NDArray[np.int64]:
    """The true fruit nearest to each Gaussian."""
    means = tree.gaussians.means.double().numpy()
    owners: NDArray[np.int64] = np.linalg.norm(means[:, None] - tree.truth.centers, axis=2).argmin(axis=1)
    return owners


def asking(*words: str, gaussians: NDArray, photos: PhotoFeatures | None = None) -> ColourChoice:
    split = ColourSplit(("apple",), (), ("apple",), WORDS, [word in words for word in WORDS])
    return ColourChoice(split, gaussians.astype(np.float32), photos)


def painted(tree: sim.Simulation, red: NDArray[np.bool_]) -> NDArray:
    """(N, 3) shares of Gaussians of true fruit that are red, or green."""
    return np.where(red[owners_of(tree)][:, None], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])


def counted(tree: sim.Simulation, choice: ColourChoice | None) -> FruitCount:
    return count_fruit(
        tree.gaussians,
        tree.probability,
        tree.cameras,
        CONFIG,
        label="apple",
        visibility=tree.visibility,
        choice=choice,
    )


def test_the_counts_of_all_colours_add_up_to_the_count_of_the_kind(tree: sim.Simulation) -> None:
    red = tree.truth.centers[:, 0] > 0.0
    every = counted(tree, None)
    parts = {word: counted(tree, asking(word, gaussians=painted(tree, red))) for word in WORDS}
    assert sum(part.count for part in parts.values()) == every.count
    assert abs(parts["red"].count - red.sum()) <= 1
    together = np.concatenate([part.centers for part in parts.values()])
    assert {tuple(center) for center in together.round(9)} == {tuple(center) for center in every.centers.round(9)}


def test_a_colour_that_no_fruit_has_is_a_counted_0_with_its_reason(tree: sim.Simulation) -> None:
    none = counted(tree, asking("blue", gaussians=painted(tree, np.ones(len(tree.truth.centers), bool))))
    assert none.count == 0
    assert none.interval == (0, 0)
    assert any(entry.reason == "its fruit are not blue" for entry in none.audit)
    found = counted(tree, None).count
    assert none.other_colors == found
    assert none.notices[-1] == f"no apple was counted, but {found} fruit of other colours were found"
    assert explain_nothing_found(none, 0.5, None) == f"the {found} fruit that were found have other colours"


def test_fruit_between_two_colours_widen_the_interval_of_each(tree: sim.Simulation) -> None:
    pure = painted(tree, np.ones(len(tree.truth.centers), bool))
    mixed = np.tile([0.51, 0.49, 0.0], (len(tree.gaussians), 1))
    certain, doubtful = (counted(tree, asking("red", gaussians=shares)) for shares in (pure, mixed))
    assert certain.count == doubtful.count
    assert certain.interval is not None
    assert doubtful.interval is not None
    assert doubtful.interval[0] < certain.interval[0]
    assert doubtful.interval[1] > certain.interval[1]


def test_photos_tell_the_colour_where_gaussians_are_wrong(tree: sim.Simulation) -> None:
    probability = np.asarray(tree.probability, np.float64)
    pictures = draw(tree.gaussians, probability, tree.cameras)
    shapes = [picture.fruit.shape for picture in pictures]
    pixels = [height * width for height, width in shapes]
    photos = PhotoFeatures(
        shapes=torch.tensor(shapes),
        counts=torch.tensor(pixels),
        places=torch.cat([torch.arange(each, dtype=torch.int32) for each in pixels]),
        values=torch.full((sum(pixels), 1), 255, dtype=torch.uint8),
        offsets=torch.zeros(sum(pixels), 2, dtype=torch.int8),
        colours=torch.tensor([190, 30, 40], dtype=torch.uint8).repeat(sum(pixels), 1),
        scales=torch.ones(len(shapes), 1),
        encoder_id="test",
    )
    green = np.tile([0.0, 1.0, 0.0], (len(tree.gaussians), 1))
    centers, radii = tree.truth.centers, tree.truth.diameters / 2.0

    def chances(maps: list[PhotoMap] | None) -> NDArray:
        choice = asking("red", gaussians=green, photos=None if maps is None else photos)
        return FruitColours(choice, tree.gaussians, probability, pictures, maps, 0.5).chances(centers, radii)

    middle = [PhotoMap(picture.fruit, np.zeros((*picture.fruit.shape, 2), np.float32)) for picture in pictures]
    others = [PhotoMap(each.probability, each.offsets + 3.0) for each in middle]
    assert (chances(None) < 0.01).all()
    assert (chances(middle) > 0.99).mean() > 0.8
    assert (chances(others) < 0.01).all()  # pixels of other fruit do not count


@pytest.mark.parametrize("axis", [0, 1])
def test_a_fruit_that_the_border_of_a_photo_cuts_has_the_colour_of_the_part_inside(axis: int) -> None:
    size, radius = 40, 6.0
    K = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    camera = Camera(K, np.eye(4), size, size)
    empty = np.zeros((size, size), np.float32)
    for place, inside in ((-3.0, True), (20.0, True), (43.0, True), (-7.0, False), (47.0, False)):
        center = np.full(3, 20.0)
        center[axis], center[2] = place, 1.0
        offsets = np.stack(np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5), axis=-1) - center[:2]
        maps = [PhotoMap(empty + 1.0, (offsets / radius).astype(np.float32))]
        shares = np.zeros((2, 1))
        rows, white = np.zeros((size, size), np.int64), np.ones((1, 1), np.float32)
        behind = np.array([center, -center])
        _add_pixels(shares, behind, np.full(2, radius), Picture(camera, empty, empty), maps[0], rows, white, 0.5)
        assert (shares[0, 0] > 0.0) == inside
        assert shares[1, 0] == 0.0
