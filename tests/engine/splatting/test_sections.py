"""Sections of a walk are joined in one frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fruitlangs.engine.scene.alignment import Similarity
from fruitlangs.engine.scene.camera import Camera, look_along
from fruitlangs.engine.splatting.gaussians import Gaussians, transform_gaussians
from fruitlangs.engine.training import _anchor_section, _transform_camera

LENS = np.array([[100.0, 0.0, 50.0], [0.0, 100.0, 40.0], [0.0, 0.0, 1.0]])
DRIFT = Similarity(1.02, Rotation.from_rotvec([0.01, -0.02, 0.03]).as_matrix(), np.array([0.05, -0.02, 0.01]))


def some_gaussians() -> Gaussians:
    random = torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(40, 3, generator=random),
        log_scales=torch.randn(40, 3, generator=random) - 3.0,
        quats=torch.nn.functional.normalize(torch.randn(40, 4, generator=random), dim=-1),
        opacity_logits=torch.randn(40, generator=random),
        sh=torch.randn(40, 4, 3, generator=random),
    )


def straight_walk() -> list[Camera]:
    """Cameras on one line, whose places alone do not determine a turn about it."""
    up = np.array([0.0, 0.0, 1.0])
    poses = [look_along(np.array([0.5 * k, -2.0, 1.0]), np.array([0.1 * (k % 3), 1.0, 0.0]), up) for k in range(8)]
    return [Camera(LENS, pose, 100, 80) for pose in poses]


def test_gaussians_and_cameras_that_drifted_together_come_back() -> None:
    given, gaussians = straight_walk(), some_gaussians()
    drifted = transform_gaussians(gaussians, DRIFT)
    back, cameras = _anchor_section(drifted, [_transform_camera(camera, DRIFT) for camera in given], given)
    np.testing.assert_allclose(back.means, gaussians.means, atol=1e-5)
    np.testing.assert_allclose(back.covariances, gaussians.covariances, atol=1e-6)
    for one, other in zip(cameras, given, strict=True):
        np.testing.assert_allclose(one.world_to_camera, other.world_to_camera, atol=1e-9)


def test_moved_gaussians_have_moved_covariances() -> None:
    gaussians = some_gaussians()
    moved = transform_gaussians(gaussians, DRIFT)
    turn = torch.from_numpy(DRIFT.scale * DRIFT.rotation).float()
    np.testing.assert_allclose(moved.covariances, turn @ gaussians.covariances @ turn.T, rtol=1e-3, atol=1e-7)


def test_a_camera_that_was_refined_against_the_others_keeps_that() -> None:
    given, gaussians = straight_walk(), some_gaussians()
    pose = given[3].world_to_camera.copy()
    pose[:3, :3] = Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix() @ pose[:3, :3]
    refined = [replace(camera, world_to_camera=pose) if k == 3 else camera for k, camera in enumerate(given)]
    _, cameras = _anchor_section(gaussians, refined, given)
    turned = cameras[3].world_to_camera[:3, :3] @ given[3].world_to_camera[:3, :3].T
    assert np.linalg.norm(Rotation.from_matrix(turned).as_rotvec()) == pytest.approx(0.01, rel=0.2)
