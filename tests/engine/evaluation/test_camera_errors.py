"""Errors of found cameras."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fruitlangs.engine.evaluation.camera_errors import camera_errors
from fruitlangs.engine.scene.camera import Camera

K = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])


def camera(rotation: Rotation, center: np.ndarray) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.as_matrix(), -rotation.apply(center)
    return Camera(K=K, world_to_camera=pose, width=100, height=80)


def walk(count: int = 20) -> tuple[list[Rotation], np.ndarray]:
    generator = np.random.default_rng(0)
    return [Rotation.random(random_state=n) for n in range(count)], generator.normal(size=(count, 3))


def named(rotations: list[Rotation], centers: np.ndarray) -> dict[str, Camera]:
    return {f"{n}.png": camera(r, c) for n, (r, c) in enumerate(zip(rotations, centers, strict=True))}


def test_cameras_in_another_frame_and_scale_have_no_error() -> None:
    rotations, centers = walk()
    turn = Rotation.from_euler("xyz", [0.3, -0.7, 1.1])
    elsewhere = named([r * turn for r in rotations], turn.inv().apply(centers) * 3.0 + [1.0, 2.0, 3.0])
    errors = camera_errors(elsewhere, named(rotations, centers))
    assert errors.center_90 < 1e-9
    assert errors.rotation_90 < 1e-4


def test_errors_are_medians_and_percentiles_of_distances_and_angles() -> None:
    rotations, centers = walk()
    turned = [Rotation.from_rotvec([0.0, np.radians(2.0), 0.0]) * r for r in rotations]
    errors = camera_errors(named(turned, centers), named(rotations, centers))
    assert errors.rotation == pytest.approx(2.0)
    assert errors.rotation_90 == pytest.approx(2.0)
    assert errors.center < 1e-9


def test_photos_without_a_found_camera_are_counted() -> None:
    found, true = named(*walk()), named(*walk())
    del found["3.png"]
    assert (camera_errors(found, true).placed, camera_errors(found, true).photos) == (19, 20)
