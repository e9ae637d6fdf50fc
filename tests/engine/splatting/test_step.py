"""What steps of training add to drawing: loads, exposure, poses, regularisers, Gaussians that are moved."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from splats import drawn_scene, random_gaussians, ring_camera

from fruitlangs.engine.config import TrainConfig
from fruitlangs.engine.scene.camera import Camera
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians
from fruitlangs.engine.splatting.rendering.reference import blending_weights, render_reference
from fruitlangs.engine.splatting.rendering.render import (
    DrawRules,
    Tiles,
    blend_view,
    load_view,
    project_view,
    tile_view,
    view_backward,
)
from fruitlangs.engine.splatting.rendering.workspace import Workspace
from fruitlangs.engine.splatting.training.exposure import Exposures, fit_exposure
from fruitlangs.engine.splatting.training.losses import unevenness
from fruitlangs.engine.splatting.training.parameters import Parameters, Rates
from fruitlangs.engine.splatting.training.photos import PhotoShelf
from fruitlangs.engine.splatting.training.poses import Poses, apply_twist, twist_gradient
from fruitlangs.engine.splatting.training.relocate import inject_noise, relocate
from fruitlangs.engine.splatting.training.step import regularise, select_inliers

BLACK = np.zeros(3, np.float32)
RATES = Rates(means=0.1, log_scales=0.1, quats=0.1, opacity_logits=0.1, sh=0.1, sh_rest=0.1)


def double(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{name: getattr(gaussians, name).double() for name in PARAMETERS})


def drawn(
    gaussians: Gaussians, camera: Camera
) -> tuple[dict[str, NDArray[np.float32]], DrawRules, Tiles, NDArray[np.float32]]:
    arrays = Parameters.start(gaussians).arrays()
    rules = DrawRules(sh_degree=gaussians.sh_degree)
    tiles = tile_view(project_view(arrays, camera, rules, Workspace()), camera, rules, Workspace())
    return arrays, rules, tiles, blend_view(tiles, np.zeros((len(gaussians), 0), np.float32), camera, Workspace())


def parameter_gradients(
    gaussians: Gaussians,
    camera: Camera,
    gradients: NDArray[np.float32],
    load_gradient: NDArray[np.float32] | None = None,
) -> dict[str, NDArray[np.float32]]:
    arrays, rules, tiles, planes = drawn(gaussians, camera)
    found = view_backward(
        arrays, camera, rules, tiles, planes, gradients, Workspace(),
        features=np.zeros((len(gaussians), 0), np.float32), background=BLACK, load_gradient=load_gradient,
    )  # fmt: skip
    for name in PARAMETERS:
        found[name][tiles.counts == 0] = 0.0
    return found


def reference_loads(gaussians: Gaussians, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """ℓ and its stand-in from the reference weights: α = weight / transmittance before."""
    weights, _ = blending_weights(gaussians, camera)
    before = 1 - torch.cat([torch.zeros_like(weights[:1]), weights.cumsum(0)[:-1]])
    alpha = torch.where(weights > 0, weights / before.clamp_min(1e-9), 0.0)
    return (weights > 0).sum(0), (alpha / (alpha + 1 / 16)).sum(0)


def test_loads_count_the_gaussians_that_a_pixel_blends() -> None:
    gaussians, camera = random_gaussians(80, 0, seed=3), ring_camera()
    _, _, tiles, planes = drawn(gaussians, camera)
    loads = load_view(tiles, planes, Workspace())
    count, soft = reference_loads(double(gaussians), camera)
    assert float((torch.from_numpy(loads[0]) != count).double().mean()) < 0.002  # α within rounding of 1/255
    torch.testing.assert_close(torch.from_numpy(loads[1]).double(), soft, rtol=1e-3, atol=0.07)


def test_the_gradient_of_the_loads_agrees_with_the_reference() -> None:
    gaussians, camera = random_gaussians(60, 0, seed=4), ring_camera()
    weights = torch.randn(camera.height, camera.width, generator=torch.Generator().manual_seed(0))
    nothing = np.zeros((5, camera.height, camera.width), np.float32)
    ours = parameter_gradients(gaussians, camera, nothing, weights.numpy())
    leaves = {name: getattr(gaussians, name).double().requires_grad_() for name in PARAMETERS}
    (reference_loads(Gaussians(**leaves), camera)[1] * weights).sum().backward()
    for name in ("means", "log_scales", "opacity_logits", "quats"):
        theirs = leaves[name].grad
        assert theirs is not None
        error = (torch.from_numpy(ours[name]).double() - theirs).abs().max() / theirs.abs().max()
        assert float(error) < 1e-3, name


def test_unevenness_is_deviation_over_mean_with_its_gradient() -> None:
    loads = np.random.default_rng(0).random((7, 9)).astype(np.float32)
    reference = torch.from_numpy(loads).double().requires_grad_()
    expected = reference.std(correction=0) / reference.mean()
    expected.backward()
    value, gradient = unevenness(loads)
    assert value == pytest.approx(expected.item(), rel=1e-6)
    assert reference.grad is not None
    torch.testing.assert_close(torch.from_numpy(gradient).double(), reference.grad, rtol=1e-4, atol=1e-8)
    assert unevenness(np.ones((3, 3), np.float32))[0] == 0.0


def test_the_gradient_of_a_pose_agrees_with_the_references_differences() -> None:
    gaussians, camera = random_gaussians(60, 2, seed=7), ring_camera(0.3)
    weights = torch.randn(
        camera.height, camera.width, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    gradients = np.zeros((5, camera.height, camera.width), np.float32)
    gradients[:3] = weights.permute(2, 0, 1).numpy()
    ours = twist_gradient(camera.world_to_camera, parameter_gradients(gaussians, camera, gradients)["pose"])

    def value(twist: NDArray[np.float64]) -> float:
        turned = replace(camera, world_to_camera=apply_twist(camera.world_to_camera, twist))
        return float((render_reference(double(gaussians), turned).color * weights).sum())

    step = 1e-6
    theirs = np.array([(value(step * axis) - value(-step * axis)) / (2 * step) for axis in np.eye(6)])
    np.testing.assert_allclose(ours, theirs, rtol=2e-2, atol=5e-3 * np.abs(theirs).max())


def test_a_pose_moves_back_to_where_the_photo_was_taken() -> None:
    camera = ring_camera(0.3)
    poses = Poses.of([camera])
    start = apply_twist(camera.world_to_camera, np.array([0.01, -0.005, 0.008, 0.02, 0.01, -0.03]))
    poses.world_to_camera[0] = start
    gaussians = random_gaussians(300, 0, seed=8, log_scale=-2.5)
    target = drawn(gaussians, camera)[3][:3].copy()
    for step in range(120):
        here = poses.camera(0, camera)
        gradients = np.zeros((5, camera.height, camera.width), np.float32)
        gradients[:3] = np.sign(drawn(gaussians, here)[3][:3] - target)
        poses.learn(0, parameter_gradients(gaussians, here, gradients)["pose"], step / 120, 4.0)

    def away(matrix: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(matrix @ np.linalg.inv(camera.world_to_camera) - np.eye(4)))

    assert away(poses.world_to_camera[0]) < 0.3 * away(start)


def test_an_exposure_is_learnt_and_undone() -> None:
    random = np.random.default_rng(0)
    image = random.random((3, 20, 30)).astype(np.float32)
    truth = np.array([[1.2, 0.1, 0, 0.02], [0, 0.9, 0, -0.03], [0.05, 0, 0.8, 0.01]], np.float32)
    photo = np.einsum("ck,khw->chw", truth[:, :3], image) + truth[:, 3, None, None]
    exposures = Exposures.neutral(2)
    for step in range(600):
        changed = exposures.apply(1, image, Workspace())
        exposures.learn(1, image, (changed - photo) * 0.5, step / 600, Workspace())
    np.testing.assert_allclose(exposures.matrices[1], truth, atol=0.03)
    np.testing.assert_array_equal(exposures.matrices[0], np.eye(3, 4, dtype=np.float32))


def test_the_gradient_of_an_exposure_reaches_the_image() -> None:
    random = np.random.default_rng(1)
    image, gradient = random.random((2, 3, 5, 6)).astype(np.float32)
    exposures = Exposures.neutral(1)
    exposures.matrices[0] = random.random((3, 4)).astype(np.float32)
    expected = np.einsum("ck,chw->khw", exposures.matrices[0][:, :3], gradient)
    exposures.learn(0, image, gradient, 0.0, Workspace())
    np.testing.assert_allclose(gradient, expected, rtol=1e-5)


def test_a_photo_held_out_is_compared_in_its_own_colours() -> None:
    random = np.random.default_rng(2)
    image = random.random((12, 10, 3)).astype(np.float32)
    photo = np.rint(255 * (0.2 + 0.6 * image)).astype(np.uint8)
    np.testing.assert_allclose(fit_exposure(image, photo, None), photo / 255, atol=0.004)


def test_only_drawn_gaussians_move_as_if_the_steps_between_had_not_been() -> None:
    start = random_gaussians(3, 1, seed=0)
    parameters, alone = Parameters.start(start), Parameters.start(start.select(torch.tensor([2])))
    random = np.random.default_rng(0)
    for step in range(30):
        gradients = {name: random.normal(size=getattr(start, name).shape).astype(np.float32) for name in PARAMETERS}
        seen = np.array([1, 0, step % 5 == 0], np.int32)
        before = parameters.values["means"].clone()
        parameters.update(gradients, RATES, 1, seen)
        assert torch.equal(before[seen == 0], parameters.values["means"][seen == 0])
        assert not torch.equal(before[0], parameters.values["means"][0])
        if seen[2]:
            alone.update({name: value[2:] for name, value in gradients.items()}, RATES, 1, np.ones(1, np.int32))
    assert parameters.updates.tolist() == [30, 0, 6]
    for name in PARAMETERS:
        assert torch.equal(parameters.values[name][2:], alone.values[name])
        assert torch.equal(parameters.second[name][2:], alone.second[name])


def test_adam_is_that_of_torch_for_what_every_view_draws() -> None:
    start = random_gaussians(5, 0, seed=3)
    parameters = Parameters.start(start)
    reference = start.means.double().clone().requires_grad_()
    optimiser = torch.optim.Adam([reference], lr=0.1, eps=1e-15)
    random = np.random.default_rng(0)
    for _ in range(20):
        gradients = {name: random.normal(size=getattr(start, name).shape).astype(np.float32) for name in PARAMETERS}
        parameters.update(gradients, RATES, 0, np.ones(5, np.int32))
        reference.grad = torch.from_numpy(gradients["means"]).double()
        optimiser.step()
    torch.testing.assert_close(parameters.values["means"].double(), reference.detach(), rtol=1e-4, atol=1e-5)


def test_harmonics_above_the_degree_stay() -> None:
    parameters = Parameters.start(random_gaussians(3, 2, seed=1))
    before = parameters.values["sh"].clone()
    gradients = {name: np.ones(getattr(parameters.gaussians(), name).shape, np.float32) for name in PARAMETERS}
    parameters.update(gradients, RATES, 1, np.ones(3, np.int32))
    assert torch.equal(parameters.values["sh"][:, 4:], before[:, 4:])
    assert not (parameters.values["sh"][:, :4] == before[:, :4]).any()


def test_dead_gaussians_move_to_the_living_and_the_number_grows_to_its_budget() -> None:
    gaussians = random_gaussians(200, 0, seed=2)
    gaussians.opacity_logits[:50] = -9.0
    gaussians.opacity_logits[50:] = gaussians.opacity_logits[50:].clamp_min(-1.0)
    parameters = Parameters.start(gaussians)
    for remaining in (3, 2, 1):
        relocate(parameters, 500, remaining, [0, remaining])
        assert float(parameters.gaussians().opacities.min()) >= 0.004
    assert len(parameters) == 500
    again = Parameters.start(gaussians)
    for remaining in (3, 2, 1):
        relocate(again, 500, remaining, [0, remaining])
    assert all(torch.equal(again.values[name], parameters.values[name]) for name in PARAMETERS)


def test_moving_gaussians_hardly_changes_the_picture() -> None:
    gaussians, camera = random_gaussians(100, 0, seed=5, log_scale=-2.0), ring_camera()
    before = drawn(gaussians, camera)[3][:3]
    parameters = Parameters.start(gaussians)
    relocate(parameters, 150, 1, [0])
    after = drawn(parameters.gaussians(), camera)[3][:3]
    assert float(np.abs(after - before).mean()) < 0.05 * float(np.abs(before).mean())


def test_noise_moves_the_faint_and_spares_the_solid() -> None:
    gaussians = random_gaussians(100, 0, seed=6)
    gaussians.opacity_logits[:50] = -6.0
    gaussians.opacity_logits[50:] = 4.0
    parameters = Parameters.start(gaussians)
    inject_noise(parameters, 4.0, 0.0, [0])
    away = (parameters.values["means"] - gaussians.means).norm(dim=1)
    assert float(away[:50].min()) > 0.0
    assert float(away[50:].max()) < 1e-6


def test_regularisers_are_the_gradients_of_means_over_gaussians() -> None:
    config = TrainConfig(opacity_weight=0.3, scale_weight=0.2, flatness_weight=0.1)
    parameters = Parameters.start(random_gaussians(20, 0, seed=9))
    leaves = {name: parameters.values[name].double().requires_grad_() for name in PARAMETERS}
    reference = Gaussians(**leaves)
    penalty = (
        0.3 * reference.opacities.mean() + 0.2 * reference.scales.mean() / 5 + 0.1 * reference.scales.amin(1).mean() / 5
    )
    penalty.backward()
    ours = {name: np.zeros(value.shape, np.float32) for name, value in leaves.items()}
    regularise(ours, parameters, config, 5.0)
    for name in ("opacity_logits", "log_scales"):
        theirs = leaves[name].grad
        assert theirs is not None
        torch.testing.assert_close(torch.from_numpy(ours[name]).double(), theirs, rtol=1e-5, atol=1e-9)


def test_the_pixels_that_differ_most_are_forgiven() -> None:
    picture = PhotoShelf(drawn_scene()).picture(0)
    image = picture.pixels.transpose(2, 0, 1) / np.float32(255)
    image[:, 4:12, 5:15] = 1.0 - image[:, 4:12, 5:15]
    use = select_inliers(image.astype(np.float32), picture, 0.2)
    assert not use[6:10, 8:12].any()
    assert use[20:].mean() > 0.9
    assert use.mean() == pytest.approx(0.8, abs=0.02)


def test_a_smaller_picture_has_the_camera_of_its_size() -> None:
    scene = drawn_scene()
    shelf = PhotoShelf(scene)
    shelf.expect(1, 2)
    whole, half = shelf.picture(1), shelf.picture(1, 2)
    assert half.pixels.shape[:2] == (round(whole.camera.height / 2), round(whole.camera.width / 2))
    assert half.camera.K[0, 0] / half.camera.width == pytest.approx(whole.camera.K[0, 0] / whole.camera.width)
    assert float(half.pixels.mean()) == pytest.approx(float(whole.pixels.mean()), rel=0.02)
    assert math.isclose(half.camera.K[0, 2] / half.camera.width, whole.camera.K[0, 2] / whole.camera.width)
    shelf.close()
