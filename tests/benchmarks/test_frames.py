"""From the frame of found poses into the truth's, on the scene of five red balls."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import ball_scene
import numpy as np
import pytest
import torch

from fruitlangs.benchmarks.ladder.frames import align_by_cameras, align_by_fruit, warp_to_view
from fruitlangs.engine.evaluation.renders import read_depths, read_instances
from fruitlangs.engine.evaluation.true_surface import true_surface
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import FilePhoto
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.gaussians import Gaussians

SCALE = 1.6
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
SHIFT = np.array([3.0, -2.0, 0.5])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_scene.write_scene(tmp_path_factory.mktemp("frames") / "balls")


@pytest.fixture(scope="module")
def true(folder: Path) -> Scene:
    return read_scene(folder)


def moved(points: np.ndarray) -> np.ndarray:
    """From the truth's frame into another."""
    return SCALE * points @ TURN.T + SHIFT


def moved_scene(scene: Scene, off: float = 0.0) -> Scene:
    """The scene in the other frame, its cameras off by normal noise of `off` scene units along their axes."""
    noise = np.random.default_rng(3)
    cameras = []
    for camera in scene.cameras:
        pose = np.eye(4)
        pose[:3, :3] = camera.world_to_camera[:3, :3] @ TURN.T
        pose[:3, 3] = -pose[:3, :3] @ moved(camera.center + off * noise.normal() * camera.forward)
        cameras.append(dataclasses.replace(camera, world_to_camera=pose))
    return dataclasses.replace(scene, cameras=cameras)


def moved_gaussians(gaussians: Gaussians) -> Gaussians:
    """Round ones on the same surfaces, in the other frame."""
    return dataclasses.replace(
        gaussians,
        means=torch.from_numpy(moved(gaussians.means.double().numpy())).float(),
        log_scales=gaussians.log_scales[:, :1].expand(-1, 3).contiguous() + np.log(SCALE),
    )


def test_fruit_bring_what_is_counted_into_place_although_the_cameras_are_off(folder: Path, true: Scene) -> None:
    depths, instances = read_depths(folder, true), read_instances(folder, true)
    surface = true_surface(true, depths, instances)
    found = moved_scene(true, off=0.15)
    fruit = align_by_fruit(moved_gaussians(surface.gaussians), found, true, depths, instances)
    errors = [
        np.linalg.norm(back.apply(moved(ball_scene.BALLS)) - ball_scene.BALLS, axis=1).max()
        for back in (fruit, align_by_cameras(found, true))
    ]
    assert errors[0] < 0.01
    assert errors[1] > 0.02
    assert fruit.apply_to_lengths(np.array(SCALE)) == pytest.approx(1.0, abs=0.03)


def test_without_fruit_in_the_photos_the_cameras_are_used(folder: Path, true: Scene) -> None:
    depths, instances = read_depths(folder, true), read_instances(folder, true)
    surface = true_surface(true, depths, instances)
    none = [np.zeros_like(ids) for ids in instances]
    back = align_by_fruit(moved_gaussians(surface.gaussians), moved_scene(true), true, depths, none)
    np.testing.assert_allclose(back.apply(moved(ball_scene.BALLS)), ball_scene.BALLS, atol=1e-6)


def test_views_are_paired_by_their_photos_names(true: Scene) -> None:
    found = moved_scene(true)
    found = dataclasses.replace(found, cameras=found.cameras[::-1], images=found.images[::-1])
    back = align_by_cameras(found, true)
    np.testing.assert_allclose(back.apply(moved(ball_scene.BALLS)), ball_scene.BALLS, atol=1e-6)


def test_values_of_a_photo_follow_it_when_its_lens_is_undone(true: Scene) -> None:
    photo = true.images[0]
    assert isinstance(photo, FilePhoto)
    params = (ball_scene.FOCAL, ball_scene.WIDTH / 2, ball_scene.HEIGHT / 2, 0.25)
    curved = dataclasses.replace(photo, lens=Lens("SIMPLE_RADIAL", params, ball_scene.WIDTH, ball_scene.HEIGHT))
    values, straight = photo.pixels().astype(np.float32), curved.pixels().astype(np.float32)
    assert np.abs(warp_to_view(curved, values) - straight).mean() < 0.3 * np.abs(values - straight).mean()
