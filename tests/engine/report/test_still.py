"""The picture of a count: where it is taken from, what is outlined, and where the numbers stand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from fruit_examples import fruit
from PIL import Image

from fruitlangs.engine.counting.fruit import Fruit
from fruitlangs.engine.report.ellipses import ellipses, project_ellipsoid
from fruitlangs.engine.report.framing import frame_tree
from fruitlangs.engine.report.labels import place_labels, round_length
from fruitlangs.engine.report.still import draw_still, save_still
from fruitlangs.engine.scene.camera import Camera, Scene, look_along
from fruitlangs.engine.splatting.gaussians import Gaussians, make_round_gaussians

UP = np.array([0.0, 0.0, 1.0])
RADIUS = 0.04


def camera_at(place: list[float], *, width: int = 400, height: int = 300) -> Camera:
    """A level camera that looks at the origin."""
    where = np.array(place)
    K = np.array([[300.0, 0.0, width / 2], [0.0, 300.0, height / 2], [0.0, 0.0, 1.0]])
    return Camera(K=K, world_to_camera=look_along(where, -where, UP), width=width, height=height)


def ball(number: int, place: list[float]) -> Fruit:
    return fruit(number, 0.0, center=np.array(place), axes=RADIUS * np.eye(3), diameter=2 * RADIUS)


def scene_of(cameras: list[Camera]) -> Scene:
    return Scene(cameras, [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), UP)


def skin(fruits: list[Fruit]) -> np.ndarray:
    """(P, 3) points on the fruit's balls."""
    rows = np.random.default_rng(0).normal(size=(400, 3))
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    return np.concatenate([each.center + RADIUS * rows for each in fruits])


def wall(y: float, half: float = 0.5) -> np.ndarray:
    """(P, 3) points of a wall across the y axis."""
    x, z = (side.ravel() for side in np.meshgrid(*[np.linspace(-half, half, 60)] * 2))
    return np.stack([x, np.full_like(x, y), z], axis=1)


def solid(*parts: np.ndarray) -> Gaussians:
    points = np.concatenate(parts)
    return make_round_gaussians(points, np.full(len(points), 0.012), np.full((len(points), 3), 0.4), opacity=0.98)


FRUITS = [ball(1, [-0.2, 0.0, 0.0]), ball(2, [0.2, 0.0, 0.1]), ball(3, [0.0, 0.0, -0.2])]
TREE = solid(skin(FRUITS))


def test_the_outline_is_that_of_the_ellipsoids_own_points() -> None:
    camera = camera_at([0.3, -1.0, 0.4])
    axes = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0] * np.array([[0.2], [0.1], [0.05]])
    rows = np.random.default_rng(2).normal(size=(200_000, 3))
    points = rows / np.linalg.norm(rows, axis=1, keepdims=True) @ axes
    pixels, _ = camera.project(points)
    outline = project_ellipsoid(np.zeros(3), axes, camera)
    assert outline is not None
    center, half = outline
    inside = np.linalg.norm((pixels - center) @ np.linalg.inv(half), axis=1)
    assert inside.max() == pytest.approx(1.0, abs=1e-3)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    assert np.linalg.norm(half, axis=0) == pytest.approx((high - low) / 2, rel=0.01)


def test_a_fruit_behind_the_camera_or_next_to_the_picture_has_no_outline() -> None:
    camera = camera_at([0.0, -1.0, 0.0])
    for place in ([0.0, -2.0, 0.0], [5.0, 0.0, 0.0]):
        assert project_ellipsoid(np.array(place), RADIUS * np.eye(3), camera) is None


def test_a_fruit_behind_a_wall_is_hidden_and_one_next_to_it_is_not() -> None:
    fruits = [ball(1, [0.0, 0.0, 0.0]), ball(2, [0.4, 0.0, 0.0])]
    found = ellipses(solid(skin(fruits), wall(-0.3, half=0.15)), fruits, camera_at([0.0, -1.0, 0.0]))
    assert {each.id: each.hidden for each in found} == {1: True, 2: False}


def test_the_picture_holds_every_fruit_whole() -> None:
    camera = frame_tree(scene_of([camera_at([0.0, -1.0, 0.0])]), TREE, FRUITS, width=400, height=300)
    assert (camera.width, camera.height) == (400, 300)
    for each in FRUITS:
        outline = project_ellipsoid(each.center, each.axes, camera)
        assert outline is not None
        reach = np.linalg.norm(outline[1], axis=0)
        assert (outline[0] - reach >= 0).all()
        assert (outline[0] + reach <= (400, 300)).all()


def test_the_picture_is_filled() -> None:
    camera = frame_tree(scene_of([camera_at([0.0, -9.0, 0.0])]), TREE, FRUITS, width=400, height=300)
    pixels, _ = camera.project(np.array([each.center for each in FRUITS]))
    assert (np.ptp(pixels, axis=0) / (400, 300)).max() > 0.6


def test_it_stands_where_a_photo_was_taken_even_if_photos_are_on_one_side_only() -> None:
    cameras = [camera_at([x, -3.0, 0.2]) for x in (-1.0, 0.0, 1.0)]
    camera = frame_tree(scene_of(cameras), TREE, FRUITS, width=400, height=300)
    assert min(np.linalg.norm(camera.center - photo.center) for photo in cameras) < 1e-9


@pytest.mark.parametrize("open_side", [-1.0, 1.0])
def test_it_looks_from_where_most_fruit_are_seen(open_side: float) -> None:
    tree = solid(skin(FRUITS), wall(-0.15 * open_side))
    cameras = [camera_at([0.0, -2.0, 0.0]), camera_at([0.0, 2.0, 0.0])]
    assert frame_tree(scene_of(cameras), tree, FRUITS, width=400, height=300).center[1] * open_side > 0


def test_the_same_tree_is_framed_the_same_again() -> None:
    scene = scene_of([camera_at([0.0, -2.0, 0.0]), camera_at([2.0, 0.0, 0.3])])
    first, second = (frame_tree(scene, TREE, FRUITS, width=400, height=300) for _ in range(2))
    assert (first.world_to_camera == second.world_to_camera).all()


def test_a_scene_without_cameras_is_seen_from_a_side_upright() -> None:
    camera = frame_tree(scene_of([]), TREE, FRUITS, width=400, height=300)
    assert abs(camera.forward @ UP) < 0.3
    assert camera.world_to_camera[1, :3] @ UP < -0.9  # y is down in a picture


def test_photos_straight_down_give_a_camera_straight_down() -> None:
    down = camera_at([0.0, -1.0, 0.0])
    pose = np.eye(4)
    pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    overhead = Camera(K=down.K, world_to_camera=pose, width=400, height=300)
    camera = frame_tree(scene_of([overhead]), TREE, FRUITS, width=400, height=300)
    assert camera.forward @ UP == pytest.approx(-1.0)
    assert np.isfinite(camera.world_to_camera).all()


def test_a_tree_with_many_fruit_fills_the_picture_and_the_grass_around_it_does_not() -> None:
    turns = 2.0 * np.pi * np.arange(12) / 12
    crown = [ball(number, [0.3 * np.cos(turn), 0.0, 0.3 * np.sin(turn)]) for number, turn in enumerate(turns, 1)]
    grass = solid(skin(crown), wall(0.3, half=1.5))
    scene = scene_of([camera_at([0.0, -3.0, 0.0])])
    heights = []
    for fruits in (crown, crown[:9]):
        camera = frame_tree(scene, grass, fruits, width=400, height=300)
        pixels, _ = camera.project(np.array([each.center for each in crown]))
        assert (pixels >= 0.0).all()
        assert (pixels <= [400.0, 300.0]).all()
        heights.append(np.ptp(pixels[:, 1]) / 300.0)
    assert heights[0] > 0.7
    assert heights[1] < 0.5  # fewer fruit do not tell where the crown is


@pytest.mark.parametrize("fruits", [[], FRUITS])
def test_a_tree_without_fruit_and_fruit_without_a_tree_are_framed(fruits: list[Fruit]) -> None:
    tree = TREE if not fruits else TREE.select(torch.zeros(len(TREE), dtype=torch.bool))
    camera = frame_tree(scene_of([camera_at([0.0, -2.0, 0.0])]), tree, fruits, width=400, height=300)
    assert np.isfinite(camera.world_to_camera).all()


def test_no_number_stands_on_another_nor_outside_the_picture() -> None:
    random = np.random.default_rng(5)
    centers = random.uniform(60, 240, size=(39, 2))
    sizes = np.tile([22.0, 12.0], (39, 1))
    taken = np.array([[0.0, 250.0, 120.0, 300.0]])
    labels = place_labels(centers, np.full((39, 2), 8.0), sizes, width=300, height=300, taken=taken)
    boxes = np.vstack([taken, *(label.box for label in labels)])
    assert len(labels) > 30
    assert boxes.min() >= 0.0
    assert boxes.max() <= 300.0
    for index, box in enumerate(boxes):
        others = np.delete(boxes, index, axis=0)
        apart = (others[:, :2] >= box[2:] - 1e-9).any(1) | (others[:, 2:] <= box[:2] + 1e-9).any(1)
        assert apart.all()


def test_in_a_crowd_numbers_hide_no_fruit_and_stand_next_to_their_own() -> None:
    centers = np.random.default_rng(5).uniform(60, 240, size=(80, 2))
    reaches, sizes = np.full((80, 2), 6.0), np.tile([14.0, 9.0], (80, 1))
    labels = place_labels(centers, reaches, sizes, width=300, height=300, taken=np.zeros((0, 4)))
    assert 10 < len(labels) < 80
    assert not any(label.tied for label in labels)
    for label in labels:
        others = np.delete(centers, label.index, axis=0)
        beside = (others + 6.0 <= label.box[:2] + 1e-9).any(1) | (others - 6.0 >= label.box[2:] - 1e-9).any(1)
        assert beside.all()


def test_a_lone_number_stands_next_to_its_fruit_without_a_line() -> None:
    (label,) = place_labels(
        np.array([[100.0, 100.0]]), np.array([[10.0, 10.0]]), np.array([[20.0, 12.0]]),
        width=200, height=200, taken=np.zeros((0, 4)),
    )  # fmt: skip
    assert not label.tied
    assert 10.0 < np.linalg.norm(label.middle - 100.0) < 35.0


def test_a_number_without_room_is_left_out() -> None:
    full = np.array([[0.0, 0.0, 50.0, 50.0]])
    assert not place_labels(
        np.array([[25.0, 25.0]]), np.ones((1, 2)), np.full((1, 2), 10.0), width=50, height=50, taken=full
    )


@pytest.mark.parametrize(("most", "length"), [(0.99, 0.5), (5.0, 5.0), (199.0, 100.0), (0.0021, 0.002)])
def test_a_scale_bar_has_a_round_length(most: float, length: float) -> None:
    assert round_length(most) == pytest.approx(length)


def drawn(**changes: object) -> np.ndarray:
    settings: dict = {"metres_per_unit": None, **changes}
    fruits = settings.pop("fruits", FRUITS)
    return np.asarray(draw_still(TREE, fruits, camera_at([0.0, -1.0, 0.0]), **settings)).astype(int)


def test_paper_shows_where_nothing_is_drawn() -> None:
    assert (drawn()[0, 0] == 255).all()


def test_every_fruit_leaves_its_mark() -> None:
    for each in FRUITS:
        others = [other for other in FRUITS if other.id != each.id]
        assert (drawn() != drawn(fruits=others)).any(), each.id


def test_the_scale_bar_stands_only_where_the_scale_is_known_and_has_its_length() -> None:
    difference = (drawn(metres_per_unit=1.0) != drawn()).any(axis=2)
    assert difference.any()
    # 300 px a scene unit at the fruit's depth of 1: of 88 px at most, 200 mm are 60.
    row = drawn(metres_per_unit=1.0)[-11]
    dark = np.flatnonzero((row < 90).all(axis=1))
    assert len(dark) == pytest.approx(60, abs=3)


def test_a_title_is_a_band_above_the_picture_even_with_a_dash() -> None:
    titled, dash = drawn(title="3 apples (90 %: 3-5)"), drawn(title="3 apples (90 %: 3–5)")
    assert titled.shape[0] > drawn().shape[0]
    assert (titled[-drawn().shape[0] :] == drawn()).all()
    assert (titled == dash).all()


def test_the_same_count_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        save_still(tmp_path / name, draw_still(TREE, FRUITS, camera_at([0.0, -1.0, 0.0]), metres_per_unit=1.0))
    assert (tmp_path / "a.jpg").read_bytes() == (tmp_path / "b.jpg").read_bytes()
    assert Image.open(tmp_path / "a.jpg").size == (400, 300)
