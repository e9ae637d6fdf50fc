"""Cameras around a reconstruction without any: what they look at, which way is up, what they frame."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from fruitlangs.engine.scene.orientation import upright_rotation
from fruitlangs.engine.splatting.gaussians import Gaussians
from fruitlangs.engine.splatting.subject.ground import up_from_ground
from fruitlangs.engine.splatting.subject.viewpoints import Subject, cameras_around, find_subject

UPS = [np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0]), np.array([0.6, 0.0, 0.8]), np.array([0.48, 0.6, -0.64])]


def round_gaussians(means: np.ndarray, size: float) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=torch.from_numpy(means).float(),
        log_scales=torch.full((n, 3), math.log(size)),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        opacity_logits=torch.full((n,), 3.0),
        sh=torch.zeros(n, 1, 3),
    )


def joined(*parts: Gaussians) -> Gaussians:
    names = ("means", "log_scales", "quats", "opacity_logits", "sh")
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in names))


def ball(center: tuple[float, float, float], n: int = 3000) -> np.ndarray:
    """Points spread evenly through a ball of radius 1."""
    random = np.random.default_rng(3)
    directions = random.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(center) + directions * random.random((n, 1)) ** (1 / 3)


def test_the_subject_is_where_the_detail_is_whatever_lies_far_around_it() -> None:
    sky = 60.0 * ball((0, 0, 0), 4000) + [200.0, 0.0, 0.0]
    subject = find_subject(joined(round_gaussians(ball((1.0, 2.0, 3.0)), 0.02), round_gaussians(sky, 0.3)))
    np.testing.assert_allclose(subject.center, [1.0, 2.0, 3.0], atol=0.05)
    assert 0.9 < subject.radius < 1.05


def tree_on_lawn(up: np.ndarray) -> Gaussians:
    """A ball 1.5 above a flat square of few larger Gaussians, turned so that `up` points away from it."""
    random = np.random.default_rng(4)
    lawn = np.stack([*(random.random((2, 900)) * 6 - 3), random.normal(-1.5, 0.01, 900)], axis=1)
    turn = upright_rotation(up)
    return joined(round_gaussians(ball((0, 0, 0)) @ turn, 0.02), round_gaussians(lawn @ turn, 0.06))


@pytest.mark.parametrize("up", UPS, ids=str)
def test_up_is_away_from_the_ground_however_the_frame_is_turned(up: np.ndarray) -> None:
    gaussians = tree_on_lawn(up)
    found = up_from_ground(gaussians, find_subject(gaussians))
    assert found is not None
    assert found @ up > math.cos(math.radians(2))


def test_the_order_of_the_gaussians_does_not_change_the_ground() -> None:
    smooth = tree_on_lawn(UPS[0])
    rough = torch.randn(smooth.means.shape, generator=torch.Generator().manual_seed(0)) * 0.1
    gaussians = dataclasses.replace(smooth, means=smooth.means + rough)
    subject = find_subject(gaussians)
    shuffled = gaussians.select(torch.from_numpy(np.random.default_rng(1).permutation(len(gaussians))))
    here, there = up_from_ground(gaussians, subject), up_from_ground(shuffled, subject)
    assert here is not None
    assert there is not None
    np.testing.assert_allclose(here, there, atol=1e-9)


def test_a_cloud_without_a_ground_gives_no_up() -> None:
    gaussians = round_gaussians(ball((0, 0, 0)), 0.02)
    assert up_from_ground(gaussians, find_subject(gaussians)) is None


@pytest.mark.parametrize("up", UPS, ids=str)
def test_every_camera_stands_upright_and_holds_the_whole_subject(up: np.ndarray) -> None:
    subject = Subject(np.array([5.0, -2.0, 1.0]), 2.0)
    surface = ball((0, 0, 0))
    surface = subject.center + 2.0 * surface / np.linalg.norm(surface, axis=1, keepdims=True)
    for camera in cameras_around(subject, up):
        rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        assert abs(rotation[0] @ up) < 1e-12
        assert rotation[1] @ up < 0  # y is down
        pixels = (surface @ rotation.T + shift) @ camera.K.T
        places = pixels[:, :2] / pixels[:, 2:]
        assert (pixels[:, 2] > 0).all()
        assert (places > 0).all()
        assert (places < [camera.width, camera.height]).all()
        assert np.ptp(places[:, 1]) > 0.7 * camera.height
