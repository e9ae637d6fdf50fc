"""Features of masks reach the Gaussians that drew them."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from splats import random_gaussians, ring_camera
from torch import Tensor
from torch.nn import functional

from fruitlangs.engine.errors import Cancelled, EncoderError, SceneError
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.features.lift import lift_features
from fruitlangs.engine.language.features.lift_segments import lift_segments
from fruitlangs.engine.language.masks.segments import SegmentedView
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.gaussians import Gaussians
from fruitlangs.engine.splatting.rendering.label_weights import label_weights
from fruitlangs.engine.splatting.rendering.rasterize import accumulate

DIMENSION = 19
"""No multiple of a vector's lanes."""


def cameras(count: int) -> list[Camera]:
    return [ring_camera(2 * math.pi * view / count) for view in range(count)]


def patches(camera: Camera, seed: int, sides: tuple[int, ...] = (5, 11, 40)) -> NDArray[np.int32]:
    """(L, H, W) squares of these sides in px, a quarter of them left out, numbered over all levels."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: camera.height, : camera.width]
    levels, count = [], 0
    for side in sides:
        squares = (y // side) * 100 + x // side
        squares = np.where(np.isin(squares, rng.choice(np.unique(squares), len(np.unique(squares)) // 4)), -1, squares)
        found, numbers = np.unique(squares, return_inverse=True)
        numbers = numbers.reshape(squares.shape) - (found[0] < 0)
        levels.append(np.where(numbers >= 0, numbers + count, -1))
        count += numbers.max() + 1
    return np.stack(levels).astype(np.int32)


def segmented(camera: Camera, seed: int) -> SegmentedView:
    labels = patches(camera, seed)
    generator = torch.Generator().manual_seed(seed)
    return SegmentedView(labels, functional.normalize(torch.randn(labels.max() + 1, DIMENSION, generator=generator)))


def pictures(view: SegmentedView, level: int) -> Tensor:
    """(H, W, D) the masks' features of one level, 0 outside."""
    padded = torch.cat([view.vectors, torch.zeros(1, view.vectors.shape[1])])
    return padded[torch.from_numpy(view.labels[level]).long()]


@pytest.fixture(scope="module")
def gaussians() -> Gaussians:
    return random_gaussians(300, 0, 3)


def lifted(gaussians: Gaussians, views: list[SegmentedView], **options: int) -> Features:
    return lift_segments(gaussians, cameras(len(views)), views, encoder_id="x", **options)


def test_masks_are_lifted_as_pictures_that_are_constant_in_each_mask(gaussians: Gaussians):
    views = [segmented(camera, seed) for seed, camera in enumerate(cameras(5))]
    sparse = lifted(gaussians, views)
    for level in range(3):
        dense = lift_features(gaussians, cameras(5), [pictures(view, level) for view in views], encoder_id="x")
        # Half precision of a unit vector's numbers is good to 2.5e-4; before it they agree to 1e-4 (below).
        assert torch.allclose(sparse.unit(level), dense.unit(0), atol=3e-4)
        assert torch.allclose(sparse.weights[:, level], dense.weights[:, 0], rtol=1e-4, atol=1e-5)
        assert torch.allclose(sparse.agreement[:, level], dense.agreement[:, 0], atol=1e-4)


def test_label_weights_are_sums_of_blending_weights_over_each_label(gaussians: Gaussians):
    camera = ring_camera()
    labels = patches(camera, 0)[0]
    table = label_weights(gaussians, camera, labels)
    found = np.zeros((len(gaussians), labels.max() + 1))
    rows = np.repeat(np.arange(len(gaussians)), np.diff(table.starts))
    assert len(np.unique(rows * 10_000 + table.labels)) == len(rows)
    found[rows, table.labels] = table.weights
    one_hot = functional.one_hot(torch.from_numpy(labels).long() + 1)[..., 1:].float()
    assert np.allclose(found, accumulate(gaussians, camera, one_hot).sums.numpy(), rtol=1e-4, atol=1e-5)


def test_the_number_of_threads_changes_no_bit(gaussians: Gaussians):
    views = [segmented(camera, seed) for seed, camera in enumerate(cameras(3))]
    before = numba.get_num_threads()
    found = []
    try:
        for count in (1, before):
            numba.set_num_threads(count)
            found.append(lifted(gaussians, views, rounds=2))
    finally:
        numba.set_num_threads(before)
    assert torch.equal(found[0].vectors, found[1].vectors)
    assert torch.equal(found[0].weights, found[1].weights)
    assert torch.equal(found[0].agreement, found[1].agreement)


def test_a_view_without_masks_changes_nothing(gaussians: Gaussians):
    views = [segmented(camera, seed) for seed, camera in enumerate(cameras(3))]
    empty = SegmentedView(np.full_like(views[0].labels, -1), torch.zeros(0, DIMENSION))
    alone = lift_segments(gaussians, [cameras(3)[0], cameras(3)[2]], [views[0], views[2]], encoder_id="x")
    among = lift_segments(gaussians, cameras(3), [views[0], empty, views[2]], encoder_id="x")
    assert torch.equal(alone.vectors, among.vectors)
    assert torch.equal(alone.weights, among.weights)


def test_no_mask_in_any_photo_is_refused(gaussians: Gaussians):
    empty = SegmentedView(np.full((3, 50, 70), -1, np.int32), torch.zeros(0, DIMENSION))
    with pytest.raises(SceneError, match="No photo has a mask"):
        lifted(gaussians, [empty] * 2)


def test_a_mask_with_a_zero_vector_counts_as_no_mask(gaussians: Gaussians):
    view = segmented(ring_camera(), 0)
    zeroed = view.vectors.clone()
    zeroed[7] = 0.0
    assert (view.labels == 7).any()
    without = np.where(view.labels == 7, -1, view.labels)
    expected = lifted(gaussians, [SegmentedView(without, view.vectors)])
    found = lifted(gaussians, [SegmentedView(view.labels, zeroed)])
    assert torch.equal(found.vectors, expected.vectors)
    assert torch.equal(found.weights, expected.weights)


def test_the_length_of_a_masks_vector_does_not_matter(gaussians: Gaussians):
    view = segmented(ring_camera(), 0)
    longer = view.vectors * torch.linspace(0.5, 2.0, len(view.vectors))[:, None]
    found = lifted(gaussians, [SegmentedView(view.labels, longer)])
    assert torch.allclose(found.unit(0), lifted(gaussians, [view]).unit(0), atol=1e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_vector_that_is_not_finite_is_refused_with_its_view_and_mask(gaussians: Gaussians, value: float):
    views = [segmented(camera, seed) for seed, camera in enumerate(cameras(2))]
    views[1].vectors[4, 2] = value
    with pytest.raises(EncoderError, match="mask 4 of view 1"):
        lifted(gaussians, views)


def test_a_label_without_a_vector_is_refused(gaussians: Gaussians):
    view = segmented(ring_camera(), 0)
    with pytest.raises(SceneError, match="Give each mask one"):
        lifted(gaussians, [SegmentedView(view.labels, view.vectors[:-1])])


@pytest.mark.parametrize("count", [1, 3])
def test_as_many_views_as_cameras_are_needed(gaussians: Gaussians, count: int):
    views = [segmented(ring_camera(), seed) for seed in range(count)]
    with pytest.raises(SceneError, match="views"):
        lift_segments(gaussians, cameras(2), views, encoder_id="x")


def test_labels_of_another_size_than_the_cameras_are_refused(gaussians: Gaussians):
    view = segmented(ring_camera(width=40, height=30), 0)
    with pytest.raises(SceneError, match="its camera has 70×50"):
        lifted(gaussians, [view])


def test_views_with_other_levels_are_refused(gaussians: Gaussians):
    view = segmented(ring_camera(), 0)
    fewer = SegmentedView(np.where(view.labels[:2] < len(view.vectors), view.labels[:2], -1), view.vectors)
    with pytest.raises(SceneError, match="Segment all photos the same way"):
        lifted(gaussians, [view, fewer])


def one_says_otherwise(views: int, wrong: int) -> tuple[Gaussians, list[SegmentedView]]:
    """Gaussians that all views call (1, 0, …) but the first `wrong`, which call them (0, 1, 0, …)."""
    labels = np.zeros((1, 50, 70), np.int32)
    right, other = torch.eye(DIMENSION)[:1], torch.eye(DIMENSION)[1:2]
    return random_gaussians(40, 0, 1), [
        SegmentedView(labels, other if view < wrong else right) for view in range(views)
    ]


def test_agreement_falls_where_a_view_says_otherwise():
    gaussians, views = one_says_otherwise(8, 2)
    seen = lifted(gaussians, views).weights[:, 0] > 5.0
    assert seen.any()
    assert torch.allclose(lifted(gaussians, views[2:]).agreement[seen], torch.ones(()), atol=1e-4)
    assert float(lifted(gaussians, views).agreement[seen].mean()) < 0.9


def test_rounds_lower_the_views_that_disagree():
    gaussians, views = one_says_otherwise(8, 2)
    mean, median = lifted(gaussians, views), lifted(gaussians, views, rounds=8)
    right, seen = torch.eye(DIMENSION)[0], mean.weights[:, 0] > 5.0
    seen &= mean.unit(0) @ right > 0.9  # the right views outweigh the wrong ones
    assert float((mean.unit(0)[seen] @ right).mean()) < 0.98
    assert float((median.unit(0)[seen] @ right).min()) > 0.999


def test_lifting_can_be_cancelled(gaussians: Gaussians):
    def stop(fraction: float, message: str) -> None:
        if "mixing" in message:
            raise Cancelled

    with pytest.raises(Cancelled):
        lift_segments(gaussians, cameras(1), [segmented(ring_camera(), 0)], encoder_id="x", progress=stop)
