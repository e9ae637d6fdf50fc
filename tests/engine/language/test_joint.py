"""Codes of masks are trained into the Gaussians along with colour."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from splats import drawn_scene, random_gaussians
from torch import Tensor
from torch.nn import functional

from fruitlangs.engine.config import EmbedConfig, TrainConfig
from fruitlangs.engine.errors import Cancelled, EncoderError, SceneError
from fruitlangs.engine.language.features.joint import Semantics, judge_channels, prepare_joint, sample_nearest
from fruitlangs.engine.language.masks.segments import SegmentedView
from fruitlangs.engine.scene.camera import Scene
from fruitlangs.engine.splatting.gaussians import PARAMETERS, Gaussians
from fruitlangs.engine.splatting.kernels.tile import CHANNELS as PLANES
from fruitlangs.engine.splatting.rendering.reference import render_reference
from fruitlangs.engine.splatting.rendering.render import DrawRules, blend_view, project_view, tile_view, view_backward
from fruitlangs.engine.splatting.rendering.workspace import Workspace
from fruitlangs.engine.splatting.training.densify import DensifyRules, GradientStats, densify
from fruitlangs.engine.splatting.training.parameters import CHANNELS, Parameters, Rates
from fruitlangs.engine.splatting.training.relocate import relocate
from fruitlangs.engine.splatting.training.train import Training, train

QUICK = TrainConfig(steps=60, max_gaussians=200, holdout_every=4, densify_every=10, checkpoint_every=20)
EMBED = EmbedConfig(code_epochs=400, semantic_after=0.2)
DIMENSION = 16
WORDS = functional.normalize(torch.randn(4, DIMENSION, generator=torch.Generator().manual_seed(5)), dim=-1)


def segmented(scene: Scene) -> list[SegmentedView]:
    """Two levels: bright and dark pixels; the same where the photo is red, no mask elsewhere. Three vectors a view."""
    views = []
    for photo in scene.images:
        pixels = photo.pixels().astype(int)
        bright = np.where(pixels.sum(2) > 300, 0, 1)
        red = np.where(pixels[..., 0] > pixels[..., 2], 2, -1)
        views.append(SegmentedView(np.stack([bright, red]).astype(np.int32), WORDS[:3]))
    return views


@pytest.fixture(scope="module")
def scene() -> Scene:
    return drawn_scene()


@pytest.fixture(scope="module")
def semantics(scene: Scene) -> Semantics:
    return prepare_joint(scene.cameras, segmented(scene), EMBED, encoder_id="x")


@pytest.fixture(scope="module")
def alone(scene: Scene) -> Training:
    return train(scene, QUICK)


@pytest.fixture(scope="module")
def together(scene: Scene, semantics: Semantics) -> Training:
    return train(scene, QUICK, extra=semantics.channels(EMBED))


def same(a: Gaussians, b: Gaussians) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in PARAMETERS)


def reference_loss(drawn: Tensor, view: SegmentedView, semantics: Semantics) -> Tensor:
    """Eq. 8 of one view: per level the mean of |F - H| + 1 - cos over the pixels with a mask at any level."""
    (autoencoder,) = semantics.autoencoders
    total = torch.zeros((), dtype=torch.float64)
    somewhere = torch.from_numpy((view.labels >= 0).any(0)).sum()
    for level, labels in enumerate(torch.from_numpy(view.labels).long()):
        codes = autoencoder.encode(view.vectors).double()[labels.clamp_min(0)]
        given = drawn[..., 3 * level : 3 * level + 3]
        each = (given - codes).abs().mean(-1) + 1.0 - functional.cosine_similarity(given, codes, dim=-1, eps=1e-12)
        long = given.norm(dim=-1) > 1e-3
        total = total + torch.where((labels >= 0) & long, each, 0.0).sum() / somewhere
    return total


@pytest.mark.parametrize("push", [False, True])
def test_the_gradient_of_the_codes_agrees_with_the_reference(scene: Scene, semantics: Semantics, push: bool):
    gaussians, camera, view = random_gaussians(60, 0, 4), scene.cameras[1], segmented(scene)[1]
    codes = torch.randn(60, 6, generator=torch.Generator().manual_seed(2))
    arrays, rules, workspace = Parameters.start(gaussians).arrays(), DrawRules(sh_degree=0), Workspace()
    tiles = tile_view(project_view(arrays, camera, rules, workspace), camera, rules, workspace)
    planes = blend_view(tiles, codes.numpy(), camera, workspace)
    gradients = np.zeros((5 + 6, camera.height, camera.width), np.float32)
    drawn = planes[PLANES:]
    # Where nothing is drawn the cosine says nothing: keep the reference loss there out of the comparison by its length.
    semantics.loss(1.0, 1, drawn, gradients[5:])
    gradients[5:] *= np.repeat(np.linalg.norm(drawn.reshape(2, 3, *drawn.shape[1:]), axis=1) > 1e-3, 3, 0)
    found = view_backward(
        arrays, camera, rules, tiles, planes, gradients, workspace,
        features=codes.numpy(), background=np.zeros(3, np.float32), features_push=push,
    )  # fmt: skip
    leaves = {name: getattr(gaussians, name).double().requires_grad_() for name in PARAMETERS}
    leaf = codes.double().requires_grad_()
    image = render_reference(Gaussians(**leaves), camera, features=leaf).features
    assert image is not None
    reference_loss(image, view, semantics).backward()
    assert leaf.grad is not None
    assert leaves["means"].grad is not None
    assert close(found["features"], leaf.grad, 2e-3)
    undrawn = tiles.counts == 0
    found["means"][undrawn] = 0.0
    if push:
        assert close(found["means"], leaves["means"].grad, 1e-2)
    else:
        assert not found["means"].any()


def close(ours: np.ndarray, theirs: Tensor, tolerance: float) -> bool:
    return float((torch.from_numpy(ours).double() - theirs).abs().max() / theirs.abs().max()) < tolerance


def test_the_loss_of_a_drawn_view_is_that_of_the_reference(scene: Scene, semantics: Semantics):
    camera, view = scene.cameras[2], segmented(scene)[2]
    drawn = torch.randn(6, camera.height, camera.width, generator=torch.Generator().manual_seed(0))
    gradient = np.empty_like(drawn.numpy())
    found = semantics.loss(0.3, 2, drawn.numpy(), gradient)
    expected = 0.3 * reference_loss(drawn.permute(1, 2, 0).double(), view, semantics)
    assert found == pytest.approx(float(expected), rel=1e-4)
    outside = view.labels[1] < 0
    assert outside.any()
    assert not gradient[3:, outside].any()
    assert gradient[:3, outside].any()


def test_colour_is_not_changed_by_codes_that_are_trained_along(alone: Training, together: Training):
    assert same(alone.gaussians, together.gaussians)
    assert alone.psnr == together.psnr
    assert alone.channels.shape == (len(alone.gaussians), 0)
    assert together.channels.shape == (len(together.gaussians), 6)


def test_the_semantic_loss_moves_gaussians_where_it_may(scene: Scene, semantics: Semantics, alone: Training):
    moving = train(scene, QUICK, extra=semantics.channels(replace(EMBED, semantic_moves=True)))
    assert not same(alone.gaussians, moving.gaussians)


def test_trained_codes_answer_with_the_words_of_their_pixels(scene: Scene, semantics: Semantics, together: Training):
    features = judge_channels(semantics, together.channels, together.gaussians, scene.cameras, segmented(scene))
    seen = features.weights > 20.0
    assert int(seen[:, 1].sum()) > 10
    # At the second level there is one word only; at the first most pixels around a Gaussian say one of two.
    assert float((features.unit(1)[seen[:, 1]] @ WORDS[2]).mean()) > 0.9
    assert float((features.unit(0)[seen[:, 0]] @ WORDS[:2].T).amax(1).mean()) > 0.8
    assert float(features.agreement[seen].mean()) > 0.7
    assert not features.vectors[features.weights == 0].any()
    assert features.encoder_id == "x"


class _StopAt:
    def __init__(self, step: int) -> None:
        self.step = step

    def __call__(self, fraction: float, message: str) -> None:
        if message.startswith(f"step {self.step}/"):
            raise Cancelled


def test_a_resumed_joint_training_equals_the_uninterrupted_one(
    scene: Scene, semantics: Semantics, together: Training, tmp_path: Path
):
    checkpoint = tmp_path / "c.safetensors"
    with pytest.raises(Cancelled):
        train(scene, QUICK, checkpoint=checkpoint, extra=semantics.channels(EMBED), progress=_StopAt(40))
    assert checkpoint.is_file()
    resumed = train(scene, QUICK, checkpoint=checkpoint, extra=semantics.channels(EMBED))
    assert same(resumed.gaussians, together.gaussians)
    assert torch.equal(resumed.channels, together.channels)


def test_a_checkpoint_of_other_masks_is_passed_over(scene: Scene, semantics: Semantics, tmp_path: Path):
    checkpoint, told = tmp_path / "c.safetensors", []
    with pytest.raises(Cancelled):
        train(scene, QUICK, checkpoint=checkpoint, extra=semantics.channels(EMBED), progress=_StopAt(40))
    other = replace(semantics, key="another")
    train(scene, QUICK, checkpoint=checkpoint, extra=other.channels(EMBED), progress=lambda _, text: told.append(text))
    assert any(text.startswith("starting again") for text in told)


def test_clones_and_halves_take_over_the_codes_of_what_they_came_from():
    parameters = Parameters.start(random_gaussians(40, 0, 0), channels=1)
    parameters.values[CHANNELS][:, 0] = torch.arange(40.0)
    parents = {tuple(row.tolist()): float(k) for k, row in enumerate(parameters.values["sh"].reshape(40, -1))}
    mean_gradients = GradientStats(torch.ones(40), torch.ones(40))
    rules = DensifyRules(gradient=0.5, max_gaussians=70, small=0.08, opacity=0.005, oversize=10.0, extent=1.0)
    densify(parameters, mean_gradients, rules, torch.zeros(3), [0, 1])
    colours = parameters.values["sh"].reshape(len(parameters), -1)
    assert len(parameters) == 70
    expected = [parents[tuple(row.tolist())] for row in colours]
    assert parameters.values[CHANNELS][:, 0].tolist() == expected


def test_moved_gaussians_take_over_the_codes_of_where_they_go():
    gaussians = random_gaussians(60, 0, 2)
    gaussians.opacity_logits[:20] = -9.0
    parameters = Parameters.start(gaussians, channels=1)
    parameters.values[CHANNELS][:, 0] = torch.arange(60.0)
    parents = {tuple(row.tolist()): float(k) for k, row in enumerate(parameters.values["sh"].reshape(60, -1))}
    relocate(parameters, 80, 1, [0])
    assert len(parameters) == 80
    expected = [parents[tuple(row.tolist())] for row in parameters.values["sh"].reshape(80, -1)]
    assert parameters.values[CHANNELS][:, 0].tolist() == expected


def test_channels_without_a_gradient_stay():
    parameters = Parameters.start(random_gaussians(5, 0, 0), channels=2)
    parameters.values[CHANNELS] += 1.0
    rates = Rates(means=0.1, log_scales=0.1, quats=0.1, opacity_logits=0.1, sh=0.1, sh_rest=0.1, channels=0.1)
    gradients = {name: np.ones_like(value) for name, value in parameters.arrays().items()}
    parameters.update(gradients, rates, 0, np.ones(5, np.int32))
    assert torch.equal(parameters.values[CHANNELS], torch.ones(5, 2))
    parameters.update(gradients | {CHANNELS: np.ones((5, 2), np.float32)}, rates, 0, np.ones(5, np.int32))
    assert (parameters.values[CHANNELS] < 1.0).all()


def test_a_view_without_masks_has_no_loss(scene: Scene):
    views = segmented(scene)
    views[3] = SegmentedView(np.full_like(views[3].labels, -1), torch.zeros(0, DIMENSION))
    semantics = prepare_joint(scene.cameras, views, EmbedConfig(code_epochs=1), encoder_id="x")
    drawn = np.ones((6, scene.cameras[3].height, scene.cameras[3].width), np.float32)
    gradient = np.ones_like(drawn)
    assert semantics.loss(1.0, 3, drawn, gradient) == 0.0
    assert not gradient.any()


def test_no_mask_in_any_photo_is_refused(scene: Scene):
    empty = SegmentedView(np.full((2, 48, 64), -1, np.int32), torch.zeros(0, DIMENSION))
    with pytest.raises(SceneError, match="No photo has a mask"):
        prepare_joint(scene.cameras, [empty] * 8, EMBED, encoder_id="x")


def test_a_vector_that_is_not_finite_is_refused(scene: Scene):
    views = segmented(scene)
    broken = views[2].vectors.clone()
    broken[1, 3] = torch.nan
    views[2] = SegmentedView(views[2].labels, broken)
    with pytest.raises(EncoderError, match="mask 1 of view 2"):
        prepare_joint(scene.cameras, views, EMBED, encoder_id="x")


def test_a_view_drawn_at_half_size_is_compared_with_the_pixels_under_its_middles():
    cells = np.arange(6 * 8).reshape(6, 8)
    assert np.array_equal(sample_nearest(cells, 3, 4), cells[1::2, 1::2])
    assert np.array_equal(sample_nearest(cells, 6, 8), cells)
