"""True geometry as Gaussians: they lie on what the views see, and know whose it is."""

from __future__ import annotations

from pathlib import Path

import ball_scene
import numpy as np
import pytest
import torch
from PIL import Image

from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.errors import FormatError, SceneError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.evaluation.renders import _is_seen_at, check_instances, read_depths, read_instances
from fruitlangs.engine.evaluation.true_surface import TrueSurface, true_surface
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.scene.read import read_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_scene.write_scene(tmp_path_factory.mktemp("balls") / "scene")


@pytest.fixture(scope="module")
def surface(folder: Path) -> TrueSurface:
    scene = read_scene(folder)
    return true_surface(scene, read_depths(folder, scene), read_instances(folder, scene))


def test_gaussians_of_a_fruit_lie_just_below_its_surface(surface: TrueSurface) -> None:
    means = surface.gaussians.means.numpy()
    for number, (center, diameter) in enumerate(zip(ball_scene.BALLS, ball_scene.DIAMETERS, strict=True), start=1):
        distances = np.linalg.norm(means[surface.fruit == number] - center, axis=1)
        assert len(distances) > 100
        # Half a cell, which is about a pixel, below the surface.
        assert 0.90 < np.median(distances) / (diameter / 2) < 1.0


def test_their_thin_axis_is_the_normal(surface: TrueSurface) -> None:
    own = surface.fruit == 3
    outward = surface.gaussians.means.numpy()[own] - ball_scene.BALLS[2]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    normals = surface.gaussians.rotations.numpy()[own][:, :, 2]
    assert np.median(np.abs((normals * outward).sum(axis=1))) > 0.95


def test_counting_on_true_surfaces_finds_every_fruit(surface: TrueSurface, folder: Path) -> None:
    probability = torch.from_numpy((surface.fruit > 0).astype(np.float64))
    found = count_fruit(surface.gaussians, probability, read_scene(folder).cameras, CountConfig(), label="apple")
    centers = found.centers
    diameters = found.diameters
    metrics = count_metrics(centers, diameters, read_truth(folder / "truth.json"))
    assert (metrics.f1, metrics.predicted) == (1.0, 5)
    assert metrics.diameter_error < 0.1


def test_views_that_see_nothing_are_an_error(folder: Path) -> None:
    scene = read_scene(folder)
    empty = [np.zeros((ball_scene.HEIGHT, ball_scene.WIDTH), np.float32) for _ in scene.cameras]
    with pytest.raises(SceneError, match="empty"):
        true_surface(scene, empty, read_instances(folder, scene))


def test_a_truth_of_another_scene_is_refused(folder: Path) -> None:
    scene, truth = read_scene(folder), read_truth(folder / "truth.json")
    instances = read_instances(folder, scene)
    check_instances(truth, scene.cameras, instances)
    truth.centers[:] += [1.0, 0.0, 0.0]
    with pytest.raises(FormatError, match="masks of visible fruit"):
        check_instances(truth, scene.cameras, instances)


def test_a_mask_of_tall_pixels_is_searched_along_each_axis_by_its_own_focal_length() -> None:
    """A fruit 10 pixels wide and 80 high, of which only the lowest row is not hidden."""
    K = np.array([[100.0, 0.0, 50.0], [0.0, 800.0, 50.0], [0.0, 0.0, 1.0]])
    camera = Camera(K=K, world_to_camera=np.eye(4), width=100, height=100)
    mask = np.zeros((100, 100), np.uint16)
    mask[88, 50] = 1
    assert _is_seen_at(camera, mask, np.array([0.0, 0.0, 2.0]), 0.2, 1)
    mask[88, 50], mask[50, 60] = 0, 1
    assert not _is_seen_at(camera, mask, np.array([0.0, 0.0, 2.0]), 0.2, 1)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda path: path.unlink(), "incomplete"),
        (lambda path: path.write_bytes(path.read_bytes()[:60]), "damaged"),
        (lambda path: Image.new("I;16", (4, 4)).save(path), "4×4 pixels"),
        (lambda path: Image.new("RGB", (128, 96)).save(path), "not a 16-bit image"),
    ],
)
def test_a_mask_that_cannot_be_used_is_named(spoil, said, tmp_path: Path) -> None:
    folder = ball_scene.write_scene(tmp_path / "scene", views=3)
    spoil(folder / "instances" / "001.png")
    with pytest.raises(FormatError, match=said) as caught:
        read_instances(folder, read_scene(folder))
    assert "001.png" in str(caught.value)


def test_a_leaf_as_thin_as_paper_that_is_seen_from_both_sides_is_flat_along_itself() -> None:
    K = np.array([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
    front, back = np.eye(4), np.diag([-1.0, 1.0, -1.0, 1.0])
    front[2, 3] = back[2, 3] = 2.0
    scene = Scene(
        cameras=[Camera(K, pose, 8, 8) for pose in (front, back)],
        images=[ArrayPhoto(name, np.full((8, 8, 3), 100, np.uint8)) for name in ("front.png", "back.png")],
        points=np.zeros((1, 3)),
        colors=np.zeros((1, 3), np.uint8),
        up=np.array([0.0, -1.0, 0.0]),
    )
    leaf = true_surface(scene, [np.full((8, 8), 2.0, np.float32)] * 2, [np.zeros((8, 8), np.uint16)] * 2)
    assert len(leaf.gaussians) == 64
    assert torch.allclose(leaf.gaussians.rotations[:, 2, 2].abs(), torch.ones(64), atol=1e-3)
