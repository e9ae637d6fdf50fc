"""The picture of a count: of a row it has a picture of each tree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fruit_examples import count_of, fruit

from fruitlangs.engine.counting.fruit import Fruit, FruitCount, Tree
from fruitlangs.engine.report import overview
from fruitlangs.engine.report.overview import draw_count
from fruitlangs.engine.scene.camera import Camera, Scene, look_along
from fruitlangs.engine.splatting.gaussians import Gaussians, make_round_gaussians

UP = np.array([0.0, 0.0, 1.0])
FEET = (-1.0, 0.0, 1.0)
RADIUS = 0.06


def ball(number: int, tree: int | None, x: float, z: float = 0.0) -> Fruit:
    changes = {"center": np.array([x, 0.0, z]), "axes": RADIUS * np.eye(3), "diameter": 2 * RADIUS}
    return replace(fruit(number, 0.0), tree=tree, **changes)


FRUITS = [ball(1, 1, -1.1), ball(2, 1, -0.9, 0.1), ball(3, 2, 0.0), ball(4, None, 3.0)]
TREES = [Tree(number, np.array([x, 0.0, 0.0]), 0) for number, x in enumerate(FEET, start=1)]


def skin() -> Gaussians:
    """Balls of fruit, and a trunk at every tree."""
    rows = np.random.default_rng(0).normal(size=(300, 3))
    rows *= RADIUS / np.linalg.norm(rows, axis=1, keepdims=True)
    trunks = [np.array([[x, 0.2, z] for z in np.linspace(-0.4, 0.4, 200)]) for x in FEET]
    points = np.concatenate([*(each.center + rows for each in FRUITS), *trunks])
    return make_round_gaussians(points, np.full(len(points), 0.012), np.full((len(points), 3), 0.4), opacity=0.98)


def walk() -> Scene:
    K = np.array([[300.0, 0.0, 200.0], [0.0, 300.0, 150.0], [0.0, 0.0, 1.0]])
    poses = [look_along(np.array([x, -1.5, 0.0]), np.array([0.0, 1.0, 0.0]), UP) for x in np.linspace(-1.2, 1.2, 60)]
    cameras = [Camera(K=K, world_to_camera=pose, width=400, height=300) for pose in poses]
    return Scene(cameras, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), UP)


def drawn(counted: FruitCount) -> np.ndarray:
    return np.asarray(draw_count(walk(), skin(), counted, title="apple", width=400)).astype(int)


def changed_without(number: int) -> np.ndarray:
    """Where the picture of the row changes if a fruit is not counted."""
    others = [each for each in FRUITS if each.id != number]
    return np.argwhere((drawn(count_of(*FRUITS, trees=TREES)) != drawn(count_of(*others, trees=TREES))).any(axis=2))


def test_a_row_has_a_picture_of_each_tree_two_side_by_side() -> None:
    row = drawn(count_of(*FRUITS, trees=TREES))
    assert row.shape[1] == 400
    high = row.shape[0] // 2
    assert (row[-high + 30 :, 200:] == 255).all()  # the place of a fourth tree
    assert not (row[-high + 30 :, :200] == 255).all()


def test_the_picture_of_a_tree_shows_its_own_fruit_only() -> None:
    changed = changed_without(3)
    (top, left), (bottom, right) = changed.min(axis=0), changed.max(axis=0)
    assert left >= 200
    assert top >= 20
    assert bottom < 190
    assert right < 400
    assert not len(changed_without(4))


def test_a_tree_of_which_nothing_was_reconstructed_has_a_picture_too() -> None:
    far = Tree(4, np.array([2.0, 0.0, 0.0]), 0)
    gaussians = skin()
    near = gaussians.select(gaussians.means[:, 0] < 1.2)
    counted = count_of(*FRUITS[:3], trees=[*TREES, far])
    assert draw_count(walk(), near, counted, title="apple", width=400).height > 300


def test_a_long_row_has_pictures_of_its_first_trees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overview, "MOST", 2)
    assert drawn(count_of(*FRUITS, trees=TREES)).shape[0] < 200
    assert drawn(count_of(*FRUITS, trees=TREES[:2])).shape[0] < 200


def test_a_row_of_one_tree_is_drawn_as_a_tree() -> None:
    assert (drawn(count_of(*FRUITS, trees=TREES[:1])) == drawn(count_of(*FRUITS))).all()
