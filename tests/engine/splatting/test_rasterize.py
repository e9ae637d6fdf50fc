"""The rasteriser against its float64 reference, and the laws it must keep."""

from __future__ import annotations

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch
from splats import random_gaussians, ring_camera

from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians
from fruitlangs.engine.splatting.kernels.surface import NOTHING
from fruitlangs.engine.splatting.rendering.agreement import compare_with_reference
from fruitlangs.engine.splatting.rendering.rasterize import accumulate, draw_surface, measure_load, render
from fruitlangs.engine.splatting.rendering.reference import blending_weights
from fruitlangs.engine.splatting.rendering.render import DrawRules, near_plane


def doubled(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: getattr(gaussians, name).double() for name in PARAMETERS})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_and_gradients_agree_with_the_reference(degree: int) -> None:
    errors = compare_with_reference(random_gaussians(60, degree, seed=degree), ring_camera(), seed=degree)
    assert set(errors) >= {"color", "depth", "alpha", "features", "d means", "d sh", "d quats", "d offsets"}
    assert max(errors.values()) < 1e-4, errors


def test_values_and_gradients_of_antialiased_drawing_agree_with_the_reference() -> None:
    gaussians = random_gaussians(80, 1, seed=5, log_scale=-3.5)  # many smaller than a pixel
    errors = compare_with_reference(replace(gaussians, antialiased=True), ring_camera(), seed=5)
    assert max(errors.values()) < 1e-3, errors
    assert not torch.equal(
        render(replace(gaussians, antialiased=True), ring_camera()).color, render(gaussians, ring_camera()).color
    )


def test_listing_pairs_by_a_higher_alpha_draws_less_and_the_exact_one_everything() -> None:
    gaussians, camera = random_gaussians(200, 0, seed=12), ring_camera()
    exact = render(gaussians, camera)
    assert torch.equal(render(gaussians, camera, pair_alpha=1 / 255).color, exact.color)
    coarse = render(gaussians, camera, pair_alpha=0.2)
    assert float(coarse.alpha.sum()) < float(exact.alpha.sum())
    torch.testing.assert_close(coarse.color, exact.color, rtol=0, atol=0.8)
    literal = render(gaussians, camera, literal_pairs=True)
    assert float(literal.alpha.sum()) < float(exact.alpha.sum())


def test_the_surface_of_a_pixel_is_the_gaussian_that_stops_half_of_the_light() -> None:
    gaussians, camera = random_gaussians(60, 0, seed=9), ring_camera()
    drawn = draw_surface(gaussians, camera, torch.ones(60, 1))
    weights, order = blending_weights(doubled(gaussians), camera)
    stopped = weights.cumsum(0)
    pose = torch.from_numpy(camera.world_to_camera)
    depths = (gaussians.means.double() @ pose[2, :3] + pose[2, 3])[order]
    clear = (stopped - 0.5).abs().amin(0) > 1e-4  # of rounding
    expected = torch.where(stopped[-1] > 0.5, depths[(stopped > 0.5).double().argmax(0)], float(NOTHING))
    assert 0.02 < float((stopped[-1] > 0.5).double().mean()) < 0.9
    np.testing.assert_allclose(drawn.depth[clear], expected[clear].numpy(), rtol=1e-5)
    np.testing.assert_allclose(drawn.features[..., 0], stopped[-1].numpy(), atol=1e-4)


def test_the_load_of_a_pixel_is_how_many_gaussians_it_blends() -> None:
    gaussians, camera = random_gaussians(40, 0, seed=8), ring_camera()
    gaussians.opacity_logits.sub_(3.0)  # no pixel stops early
    alone = [render(gaussians.select([k]), camera).alpha.numpy() > 0 for k in range(40)]
    load = measure_load(gaussians, camera, DrawRules(sh_degree=0))
    np.testing.assert_array_equal(load.pixels, np.sum(alone, 0))
    assert load.tiles.sum() >= sum(drawn.any() for drawn in alone)
    for fewer in (DrawRules(sh_degree=0, pair_alpha=0.02), DrawRules(sh_degree=0, literal_pairs=True)):
        assert measure_load(gaussians, camera, fewer).tiles.sum() < load.tiles.sum()


def test_gaussians_next_to_and_behind_the_camera_agree_with_the_reference() -> None:
    gaussians = random_gaussians(80, 1, seed=4, log_scale=-1.0)
    gaussians.means[:40, 2] -= 3.5
    gaussians.means[:20] *= torch.tensor([4.0, 3.0, 1.0])
    errors = compare_with_reference(gaussians, ring_camera(0.0), seed=4)
    assert max(errors.values()) < 1e-3, errors


def test_opaque_stacks_stop_as_in_the_reference() -> None:
    gaussians = random_gaussians(300, 0, seed=6, log_scale=-1.5)
    gaussians.opacity_logits.add_(4.0)
    camera = ring_camera(width=33, height=21, focal=30.0)
    assert float(render(gaussians, camera).alpha.max()) > 0.9999
    errors = compare_with_reference(gaussians, camera, seed=6)
    assert max(errors.values()) < 1e-3, errors


def test_sums_by_blending_weight_agree_with_the_reference() -> None:
    gaussians, camera = random_gaussians(60, 0, seed=3), ring_camera()
    target = torch.randn(camera.height, camera.width, 70, generator=torch.Generator().manual_seed(1))
    lifted = accumulate(gaussians, camera, target)
    weights, order = blending_weights(doubled(gaussians), camera)
    expected = torch.zeros(60, 70, dtype=torch.float64)
    expected[order] = torch.einsum("nhw,hwd->nd", weights, target.double())
    torch.testing.assert_close(lifted.sums.double(), expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(lifted.weights[order].double(), weights.sum((1, 2)), rtol=1e-4, atol=1e-4)


def test_weights_add_up_to_alpha() -> None:
    gaussians, camera = random_gaussians(200, 0, seed=8), ring_camera()
    total = float(render(gaussians, camera).alpha.double().sum())
    weights = accumulate(gaussians, camera, torch.zeros(camera.height, camera.width, 0)).weights
    assert float(weights.double().sum()) == pytest.approx(total, rel=1e-5)


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_a_scene_of_any_scale_is_drawn_and_lifted_alike(scale: float) -> None:
    gaussians, camera = random_gaussians(200, 1, seed=14), ring_camera(0.0)
    gaussians.means[0] = torch.tensor([-0.1, 0.2, -3.995])  # 5 mm in front of the camera: nearer than it draws
    gaussians.log_scales[0] = -8.0
    pose = camera.world_to_camera.copy()
    pose[:3, 3] *= scale
    other = replace(gaussians, means=gaussians.means * scale, log_scales=gaussians.log_scales + math.log(scale))
    moved = replace(camera, world_to_camera=pose)
    torch.testing.assert_close(render(other, moved).color, render(gaussians, camera).color, rtol=0, atol=1e-3)
    torch.testing.assert_close(
        render(other, moved).depth / scale, render(gaussians, camera).depth, rtol=1e-3, atol=0.01
    )
    target = torch.ones(camera.height, camera.width, 1)
    ours, theirs = accumulate(gaussians, camera, target), accumulate(other, moved, target)
    torch.testing.assert_close(theirs.weights, ours.weights, rtol=1e-2, atol=0.01)


def test_a_stray_gaussian_before_the_lens_hides_nothing() -> None:
    gaussians, camera = random_gaussians(200, 0, seed=15), ring_camera()
    before = camera.center + 0.1 * camera.world_to_camera[2, :3]
    gaussians.means[0] = torch.from_numpy(before).float()
    others = gaussians.select(torch.arange(1, 200))
    assert near_plane(others.means.numpy(), camera) > 0.1
    assert torch.equal(render(gaussians, camera).color, render(others, camera).color)


def test_a_crop_of_the_camera_draws_the_same_pixels() -> None:
    gaussians, camera = random_gaussians(300, 2, seed=9, log_scale=-3.5), ring_camera(width=100, height=70)
    whole = render(gaussians, camera).color
    K = camera.K.copy()
    K[:2, 2] -= [37, 11]
    # Only small Gaussians: J's limits move with the crop, and with them the shape of what lies far outside of it.
    crop = render(gaussians, Camera(K=K, world_to_camera=camera.world_to_camera, width=41, height=29)).color
    torch.testing.assert_close(crop, whole[11:40, 37:78], rtol=0, atol=1e-4)


def test_shuffling_the_gaussians_changes_nothing() -> None:
    gaussians, camera = random_gaussians(200, 1, seed=10), ring_camera()
    order = torch.randperm(200, generator=torch.Generator().manual_seed(0))
    assert torch.equal(render(gaussians.select(order), camera).color, render(gaussians, camera).color)


def test_threads_change_no_byte() -> None:
    camera = ring_camera(width=200, height=120, focal=150.0)

    def everything() -> list[torch.Tensor]:
        gaussians = random_gaussians(3000, 3, seed=11, log_scale=-3.0)
        for name in PARAMETERS:
            getattr(gaussians, name).requires_grad_()
        rendering = render(gaussians, camera)
        (rendering.color.square().sum() + rendering.depth.sum()).backward()
        sums = accumulate(gaussians, camera, torch.ones(120, 200, 5)).sums
        return [rendering.color.detach(), sums, *(getattr(gaussians, name).grad for name in PARAMETERS)]

    most = numba.get_num_threads()
    runs = []
    for count in (1, most, most):
        numba.set_num_threads(count)
        runs.append(everything())
    numba.set_num_threads(most)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_harmonics_above_the_asked_degree_count_nothing() -> None:
    gaussians, camera = random_gaussians(50, 2, seed=12), ring_camera()
    base = replace(gaussians, sh=gaussians.sh[:, :4])
    assert torch.equal(render(gaussians, camera, sh_degree=1).color, render(base, camera).color)


def test_depth_of_an_opaque_sheet_is_its_distance() -> None:
    sheet = Gaussians(
        means=torch.tensor([[0.0, 0.0, 0.0]]),
        log_scales=torch.tensor([[1.0, 1.0, -6.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        opacity_logits=torch.tensor([6.0]),
        sh=torch.zeros(1, 1, 3),
    )
    camera = ring_camera(0.0)
    assert float(render(sheet, camera).depth[24, 35]) == pytest.approx(4.0, abs=1e-4)


def test_nothing_in_view_draws_the_background() -> None:
    gaussians = random_gaussians(10, 0)
    gaussians.means[:, 2] -= 100.0
    background = torch.tensor([0.25, 0.5, 0.75])
    rendering = render(gaussians, ring_camera(0.0), background=background)
    assert torch.equal(rendering.color, background.expand(50, 70, 3))
    assert float(rendering.alpha.abs().max()) == 0.0
    assert float(rendering.radii.max()) == 0.0


def test_no_gaussians_at_all_draw_the_background() -> None:
    empty = random_gaussians(1, 0).select(torch.zeros(0, dtype=torch.long))
    assert float(render(empty, ring_camera()).color.abs().max()) == 0.0


def test_broken_and_boundless_gaussians_are_not_drawn() -> None:
    gaussians, camera = random_gaussians(60, 1, seed=13), ring_camera()
    good = render(gaussians.select(torch.arange(20, 60)), camera).color
    for k, value in enumerate((float("nan"), float("inf"), -float("inf"), 1e30)):
        gaussians.means[k] = value
        gaussians.log_scales[4 + k, 1] = value
        gaussians.quats[8 + k, 2] = value
        gaussians.opacity_logits[12 + k] = -value
    gaussians.opacity_logits[15] = float("nan")
    gaussians.log_scales[16] = 28.0
    gaussians.opacity_logits[17:20] = -30.0
    assert torch.equal(render(gaussians, camera).color, good)


def test_distortion_is_refused() -> None:
    camera = replace(ring_camera(), distortion=np.array([0.1, 0.0, 0.0, 0.0]))
    with pytest.raises(SceneError, match="Undistort"):
        render(random_gaussians(3, 0), camera)


def test_a_target_of_another_size_is_refused() -> None:
    with pytest.raises(SceneError, match="camera's"):
        accumulate(random_gaussians(3, 0), ring_camera(), torch.zeros(10, 10, 3))


def test_screen_pulls_are_sums_of_absolute_gradients_of_the_pixels() -> None:
    gaussians, camera = random_gaussians(3, 0, seed=3, log_scale=-1.5), ring_camera(width=20, height=18, focal=20.0)
    weights = torch.randn(18, 20, 3, generator=torch.Generator().manual_seed(2))
    mean_gradients, expected = torch.zeros(3, 2), torch.zeros(3, 2)
    gaussians.means.requires_grad_()
    (render(gaussians, camera, screen_pulls=mean_gradients).color * weights).sum().backward()
    for y in range(18):
        for x in range(20):
            offsets = torch.zeros(3, 2, requires_grad=True)
            (render(gaussians, camera, screen_offsets=offsets).color * weights)[y, x].sum().backward()
            assert offsets.grad is not None
            expected += offsets.grad.abs()
    torch.testing.assert_close(mean_gradients, expected, rtol=1e-4, atol=1e-4)
