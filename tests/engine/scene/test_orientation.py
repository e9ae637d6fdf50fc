"""Which way is up, from cameras alone."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.scene.orientation import up_direction, upright_rotation

WORLD = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
UP = WORLD @ [0.0, 0.0, 1.0]


def camera(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> Camera:
    """A camera by angles in degrees, in a world whose up is `UP`: yaw about up, pitch above the horizon, roll."""
    y, p = np.radians([yaw, pitch])
    forward = np.array([np.cos(y) * np.cos(p), np.sin(y) * np.cos(p), np.sin(p)])
    right = np.array([np.sin(y), -np.cos(y), 0.0])
    axes = np.stack([right, np.cross(forward, right), forward])
    axes = Rotation.from_euler("z", roll, degrees=True).as_matrix() @ axes
    pose = np.eye(4)
    pose[:3, :3] = axes @ WORLD.T
    return Camera(K=np.eye(3), world_to_camera=pose, width=4, height=4)


def degrees_off(up: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(up @ UP, -1.0, 1.0))))


RING = [camera(yaw, -10.0 + (yaw % 50)) for yaw in range(0, 360, 15)]


def test_level_cameras_around_a_tree_give_up() -> None:
    assert degrees_off(up_direction(RING)) < 1e-4


def test_pitch_does_not_tilt_up() -> None:
    assert degrees_off(up_direction([camera(yaw, 40.0) for yaw in range(0, 120, 10)])) < 1e-4


def test_a_few_rolled_photos_do_not_tilt_up() -> None:
    rolled = [camera(yaw, 5.0, roll) for yaw, roll in ((20, 90), (30, 90), (60, 40), (80, -25), (100, 90))]
    assert degrees_off(up_direction(RING + rolled)) < 0.5


def test_unsteady_hands_average_out() -> None:
    rng = np.random.default_rng(0)
    unsteady = [camera(yaw, rng.normal(0, 15), rng.normal(0, 3)) for yaw in range(0, 360, 6)]
    assert degrees_off(up_direction(unsteady)) < 1.5


def test_a_drone_that_looks_down_while_it_turns_gives_up() -> None:
    assert degrees_off(up_direction([camera(yaw, -92.0) for yaw in range(0, 360, 30)])) < 0.5


def test_a_drone_that_flies_to_and_fro_looking_down_gives_up() -> None:
    assert degrees_off(up_direction([camera(yaw, -90.0) for yaw in (0, 0, 180, 180, 0, 180)])) < 1e-4


def test_a_strip_that_faces_one_way_takes_the_photos_tops() -> None:
    assert degrees_off(up_direction([camera(30.0) for _ in range(8)])) < 1e-4


def test_one_camera_takes_its_photos_top() -> None:
    assert degrees_off(up_direction([camera(30.0)])) < 1e-4


@pytest.mark.parametrize(("roll", "skyward"), [(90.0, (1, 0, 0)), (-90.0, (-1, 0, 0)), (180.0, (0, 1, 0))])
def test_turned_photos_with_known_tops_give_up(roll: float, skyward: tuple[int, int, int]) -> None:
    turned = [camera(yaw, 10.0, roll) for yaw in range(0, 360, 30)]
    assert degrees_off(up_direction(turned, [np.array(skyward, dtype=float)] * len(turned))) < 1e-4


def test_phones_held_upright_without_exif_still_give_the_vertical() -> None:
    off = degrees_off(up_direction([camera(yaw, 0.0, -90.0) for yaw in range(0, 360, 30)]))
    assert min(off, 180.0 - off) < 1e-4


@pytest.mark.parametrize("up", [UP, [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1e-9, 0.0, -1.0], [0.0, 2.0, 0.0]])
def test_upright_rotation_takes_up_to_z(up: np.ndarray) -> None:
    rotation = upright_rotation(np.asarray(up))
    np.testing.assert_allclose(rotation @ up / np.linalg.norm(up), [0, 0, 1], atol=1e-8)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-8)
    assert np.linalg.det(rotation) > 0.0
