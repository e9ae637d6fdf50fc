"""The graphics card's kernels against the float64 reference and the CPU's kernels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from splats import random_gaussians, ring_camera

from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians
from fruitlangs.engine.splatting.gpu.drawing import Canvas, Computed, Size, pack_photo, view_of
from fruitlangs.engine.splatting.kernels.tile import TRANSMITTANCE
from fruitlangs.engine.splatting.rendering.agreement import compare_card_with_reference
from fruitlangs.engine.splatting.rendering.render import (
    DrawRules,
    arrays_of,
    blend_view,
    near_plane,
    project_view,
    tile_view,
)
from fruitlangs.engine.splatting.rendering.workspace import Workspace
from fruitlangs.engine.splatting.training.losses import PhotometricLoss

NEAR = 4
"""Place of the near plane in the kernels' `Plan`."""
BOUND = 2e-5
"""Largest difference from the reference, of its largest value."""


def computed(canvas: Canvas, gaussians: Gaussians, camera: Camera, pixels: NDArray[np.float32] | None = None,
             **rules: object) -> Computed:  # fmt: skip
    chosen = DrawRules(sh_degree=gaussians.sh_degree, antialiased=gaussians.antialiased, **rules)  # type: ignore[arg-type]
    view = view_of(camera, chosen, len(gaussians))
    view["with_depth"] = view["with_mean_gradients"] = 1
    return canvas.compute(arrays_of(gaussians), view, pixel_gradients=pixels)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_and_gradients_agree_with_the_reference(canvas: Canvas, degree: int) -> None:
    errors = compare_card_with_reference(canvas, random_gaussians(60, degree, seed=degree), ring_camera(), seed=degree)
    assert max(errors.values()) < BOUND, errors


def test_values_and_gradients_of_antialiased_drawing_agree_with_the_reference(canvas: Canvas) -> None:
    gaussians = replace(random_gaussians(80, 1, seed=5, log_scale=-3.5), antialiased=True)
    errors = compare_card_with_reference(canvas, gaussians, ring_camera(), seed=5)
    assert max(errors.values()) < BOUND, errors


def test_gaussians_next_to_and_behind_the_camera_agree_with_the_reference(canvas: Canvas) -> None:
    gaussians = random_gaussians(80, 1, seed=4, log_scale=-1.0)
    gaussians.means[:40, 2] -= 3.5
    gaussians.means[:20] *= torch.tensor([4.0, 3.0, 1.0])
    errors = compare_card_with_reference(canvas, gaussians, ring_camera(0.0), seed=4)
    assert max(errors.values()) < BOUND, errors


def test_opaque_stacks_stop_as_in_the_reference(canvas: Canvas) -> None:
    gaussians = random_gaussians(300, 0, seed=6, log_scale=-1.5)
    gaussians.opacity_logits.add_(4.0)
    errors = compare_card_with_reference(canvas, gaussians, ring_camera(width=33, height=21, focal=30.0), seed=6)
    assert max(errors.values()) < BOUND, errors


def lists_of(canvas: Canvas, width: int, height: int) -> list[NDArray[np.uint32]]:
    """Of each tile of the last view the Gaussians that it draws, nearest first."""
    size, card = Size(width, height), canvas.card
    [sorted_pairs] = [name for name, held in card.buffers.items() if held is canvas.list_buffers(size)["pair_of"]]
    starts = card.download("tile_starts", np.uint32, size.tiles + 1)
    pairs = int(starts[-1])
    own = card.download("owner_of", np.uint32, pairs)[card.download(sorted_pairs, np.uint32, pairs)]
    return np.split(own, starts[1:-1].astype(np.int64))


def on_cpu(gaussians: Gaussians, camera: Camera, **rules: object) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """The planes of a view, and which Gaussian is at each place of the tiles' lists."""
    chosen = DrawRules(sh_degree=gaussians.sh_degree, antialiased=gaussians.antialiased, **rules)  # type: ignore[arg-type]
    workspace = Workspace()
    tiles = tile_view(project_view(arrays_of(gaussians), camera, chosen, workspace), camera, chosen, workspace)
    planes = blend_view(tiles, np.zeros((len(gaussians), 0), np.float32), camera, workspace)
    return planes, tiles.gaussian_of[: tiles.tile_starts[-1]]


def test_the_lists_of_tiles_hold_the_gaussians_in_the_order_of_their_depth(canvas: Canvas) -> None:
    gaussians, camera = random_gaussians(3000, 1, seed=11, log_scale=-3.0), ring_camera(width=200, height=120)
    view = view_of(camera, DrawRules(sh_degree=1), len(gaussians))
    canvas.compute(arrays_of(gaussians), view)
    lists = lists_of(canvas, camera.width, camera.height)
    depths = gaussians.means.double() @ torch.from_numpy(camera.world_to_camera[2, :3]) + camera.world_to_camera[2, 3]
    single = depths.float().numpy()
    assert len(lists) == -(-200 // 16) * -(-120 // 16)
    assert sum(map(len, lists)) > 3000
    for own in lists:
        assert (np.diff(single[own]) >= -1e-6).all()
        assert len(np.unique(own)) == len(own)


def test_the_order_of_depth_is_that_of_the_cpu(canvas: Canvas) -> None:
    gaussians, camera = (
        random_gaussians(9000, 0, seed=3, log_scale=-3.0),
        ring_camera(0.0, width=8, height=16, focal=6.0),
    )
    gaussians.means[:4000] = gaussians.means[4000:8000]  # equal depths: in the order of the indices
    _, expected = on_cpu(gaussians, camera)
    canvas.compute(arrays_of(gaussians), view_of(camera, DrawRules(sh_degree=0), len(gaussians)))
    [own] = lists_of(canvas, 8, 16)
    np.testing.assert_array_equal(own, expected)


@pytest.mark.parametrize("rules", [{}, {"pair_alpha": 0.2}, {"literal_pairs": True}])
def test_a_view_is_that_of_the_cpu(canvas: Canvas, rules: dict[str, object]) -> None:
    gaussians, camera = random_gaussians(400, 2, seed=12), ring_camera(width=64, height=48)
    planes, _ = on_cpu(gaussians, camera, **rules)
    np.testing.assert_allclose(computed(canvas, gaussians, camera, **rules).planes[:5], planes[:5], atol=2e-5)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 37.0, 1e4])
def test_the_near_plane_is_that_of_the_cpu(canvas: Canvas, scale: float) -> None:
    gaussians, camera = random_gaussians(301, 0, seed=15), ring_camera()
    gaussians.means.mul_(scale)
    computed(canvas, gaussians, camera)
    near = canvas.card.download("plan", np.float32, 1, offset=NEAR)
    assert near[0] == pytest.approx(near_plane(gaussians.means.numpy(), camera), rel=1e-6)


@pytest.mark.parametrize("masked", [False, True])
def test_the_loss_and_its_gradients_are_those_of_the_cpu(canvas: Canvas, masked: bool) -> None:
    gaussians, camera = random_gaussians(200, 1, seed=2), ring_camera(width=70, height=50)
    random = np.random.default_rng(0)
    photo = random.integers(0, 256, (50, 70, 3), dtype=np.uint8)
    mask = random.random((50, 70)) > 0.3 if masked else None
    planes, _ = on_cpu(gaussians, camera)
    workspace, gradient = Workspace(), np.zeros((5, 50, 70), np.float32)
    loss = PhotometricLoss(0.2, workspace).backward(planes[:3], photo, mask, gradient[:3])
    n = 3 * (50 * 70 if mask is None else int(mask.sum()))
    view = view_of(camera, DrawRules(sh_degree=1), len(gaussians))
    view["l1_weight"], view["ssim_weight"] = 0.8 / n, 0.2 / n
    ours = canvas.compute(arrays_of(gaussians), view, photo=pack_photo(photo, mask))
    assert 0.8 * ours.sums[0] / n + 0.2 * (1 - ours.sums[1] / n) == pytest.approx(loss, rel=1e-5)
    theirs = canvas.compute(arrays_of(gaussians), view, pixel_gradients=gradient)
    for name in PARAMETERS:
        largest = float(np.abs(theirs.gradients[name]).max())
        np.testing.assert_allclose(ours.gradients[name], theirs.gradients[name], atol=1e-4 * largest)


def test_two_runs_give_equal_bytes(canvas: Canvas) -> None:
    gaussians, camera = random_gaussians(2000, 3, seed=11, log_scale=-3.0), ring_camera(width=100, height=70)
    pixels = np.random.default_rng(1).standard_normal((5, 70, 100)).astype(np.float32)
    one, other = (computed(canvas, gaussians, camera, pixels) for _ in range(2))
    assert np.array_equal(one.planes, other.planes)
    assert all(np.array_equal(one.gradients[name], other.gradients[name]) for name in one.gradients)


def test_a_view_that_shows_nothing_is_empty_and_has_no_gradients(canvas: Canvas) -> None:
    gaussians, camera = random_gaussians(20, 0), ring_camera(0.0)
    gaussians.means[:, 2] -= 50.0
    empty = computed(canvas, gaussians, camera, np.ones((5, camera.height, camera.width), np.float32))
    assert not empty.planes[:4].any()
    assert (empty.planes[TRANSMITTANCE] == 1.0).all()
    assert not any(values.any() for values in empty.gradients.values())


def test_values_that_are_not_finite_are_not_drawn(canvas: Canvas) -> None:
    gaussians, camera = random_gaussians(60, 0), ring_camera()
    whole = computed(canvas, gaussians.select(torch.arange(3, 60)), camera).planes
    gaussians.means[0], gaussians.log_scales[1], gaussians.quats[2] = float("nan"), float("inf"), float("nan")
    np.testing.assert_array_equal(computed(canvas, gaussians, camera).planes[:5], whole[:5])


def test_a_view_with_more_pairs_than_room_is_drawn_with_more_room(canvas: Canvas) -> None:
    gaussians, camera = random_gaussians(3000, 0, seed=1, log_scale=0.0), ring_camera(width=160, height=128)
    canvas.capacity = 1000
    planes, _ = on_cpu(gaussians, camera)
    np.testing.assert_allclose(computed(canvas, gaussians, camera).planes[:3], planes[:3], atol=1e-4)
    assert canvas.capacity > 100_000
