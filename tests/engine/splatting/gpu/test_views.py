"""Views, surfaces and sums that a graphics card draws are those of the CPU, and a card that fails is not used."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array
from splats import random_gaussians, ring_camera

from fruitlangs.engine.errors import GpuError
from fruitlangs.engine.splatting.gpu import card as card_module
from fruitlangs.engine.splatting.gpu.adapters import Adapter
from fruitlangs.engine.splatting.gpu.card import Card
from fruitlangs.engine.splatting.gpu.views import CardViews
from fruitlangs.engine.splatting.rendering.device import use_card
from fruitlangs.engine.splatting.rendering.label_weights import label_weights
from fruitlangs.engine.splatting.rendering.rasterize import accumulate, draw_surface, render


@pytest.fixture(scope="module")
def views(adapter: Adapter) -> CardViews:
    return CardViews(adapter)


@pytest.fixture
def drawn(adapter: Adapter, views: CardViews) -> Any:
    """Everything is drawn on the card."""
    with use_card(adapter) as card:
        assert card is not None
        card.views = views
        yield card
        assert not card.problem


@pytest.mark.parametrize("channels", [0, 1, 8, 512])
def test_a_view_with_further_channels_is_that_of_the_cpu(channels: int, drawn: Any) -> None:
    gaussians, camera = random_gaussians(300, 2, seed=1), ring_camera()
    features = torch.randn(300, channels, generator=torch.Generator().manual_seed(2))
    ours = render(gaussians, camera, features=features, background=torch.tensor([0.2, 0.4, 0.6]))
    with use_card(None):
        theirs = render(gaussians, camera, features=features, background=torch.tensor([0.2, 0.4, 0.6]))
    assert len(ours.radii) == 0
    for name in ("color", "alpha", "weighted_depth", "features"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=0, atol=2e-4)


@pytest.mark.parametrize("channels", [0, 15, 16, 512])
def test_sums_by_blending_weight_are_those_of_the_cpu(channels: int, drawn: Any) -> None:
    gaussians, camera = random_gaussians(400, 0, seed=3), ring_camera()
    target = torch.randn(camera.height, camera.width, channels, generator=torch.Generator().manual_seed(1))
    ours = accumulate(gaussians, camera, target)
    with use_card(None):
        theirs = accumulate(gaussians, camera, target)
    torch.testing.assert_close(ours.sums, theirs.sums, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(ours.weights, theirs.weights, rtol=1e-3, atol=1e-3)


def test_sums_by_label_are_those_of_the_cpu(drawn: Any) -> None:
    gaussians, camera = random_gaussians(300, 0, seed=6), ring_camera()
    labels = np.random.default_rng(0).integers(-1, 90, (camera.height // 5, camera.width // 5)).astype(np.int32)
    labels = labels.repeat(5, 0).repeat(5, 1)
    ours = label_weights(gaussians, camera, labels)
    with use_card(None):
        theirs = label_weights(gaussians, camera, labels)
    tables = [csr_array((each.weights, each.labels, each.starts), shape=(300, 90)).toarray() for each in (ours, theirs)]
    assert tables[1].any()
    np.testing.assert_allclose(tables[0], tables[1], atol=1e-3)
    assert not label_weights(gaussians, camera, np.full_like(labels, -1)).starts.any()


def test_surfaces_are_those_of_the_cpu(drawn: Any) -> None:
    gaussians, camera = random_gaussians(200, 0, seed=9), ring_camera()
    ours = draw_surface(gaussians, camera, torch.ones(200, 2))
    with use_card(None):
        theirs = draw_surface(gaussians, camera, torch.ones(200, 2))
    assert np.mean(np.abs(ours.depth / theirs.depth - 1.0) > 1e-5) < 1e-3  # a pixel whose T is one half to rounding
    np.testing.assert_allclose(ours.features, theirs.features, atol=1e-4)


def test_other_colours_of_the_same_gaussians_are_drawn(drawn: Any) -> None:
    gaussians, camera = random_gaussians(100, 0, seed=4), ring_camera()
    render(gaussians, camera)
    black = render(replace(gaussians, sh=gaussians.sh - 10.0), camera)
    assert not black.color.any()
    gaussians.opacity_logits.fill_(-20.0)
    assert not render(gaussians, camera).alpha.any()


def test_gradients_are_computed_by_the_cpu(drawn: Any) -> None:
    gaussians = random_gaussians(50, 0)
    gaussians.means.requires_grad_()
    render(gaussians, ring_camera()).color.sum().backward()
    assert gaussians.means.grad is not None
    assert gaussians.means.grad.any()


def test_a_card_that_draws_something_else_is_not_used(adapter: Adapter, monkeypatch: pytest.MonkeyPatch) -> None:
    source = card_module._source
    wrong = "const MAX_ALPHA: f32 = 0.3"
    monkeypatch.setattr(card_module, "_source", lambda name: source(name).replace("const MAX_ALPHA: f32 = 0.99", wrong))
    gaussians, camera = random_gaussians(300, 0, seed=1), ring_camera()
    expected = render(gaussians, camera)
    with use_card(adapter) as card:
        assert torch.equal(render(gaussians, camera).color, expected.color)
    assert card is not None
    assert "draws another image than the CPU" in card.problem


def test_when_the_card_is_lost_the_cpu_draws_the_rest(
    adapter: Adapter, views: CardViews, monkeypatch: pytest.MonkeyPatch
) -> None:
    def lose(card: Card, commands: Any) -> None:
        raise GpuError("the device is lost")

    gaussians, camera = random_gaussians(100, 0, seed=1), ring_camera()
    expected = render(gaussians, camera)
    monkeypatch.setattr(Card, "submit", lose)
    with use_card(adapter) as card:
        assert card is not None
        card.views = views
        assert torch.equal(render(gaussians, camera).color, expected.color)
        assert card.problem == "the device is lost"
    with use_card(adapter) as other:
        assert other is not None
        assert not other.problem


def test_features_that_do_not_fit_into_one_buffer_are_drawn_in_parts(
    drawn: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    gaussians, camera = random_gaussians(300, 0, seed=1), ring_camera()
    features = torch.randn(300, 20, generator=torch.Generator().manual_seed(2))
    at_once = render(gaussians, camera, features=features).features
    monkeypatch.setattr(Adapter, "largest_buffer", 12 * 4 * camera.width * camera.height)
    assert torch.equal(render(gaussians, camera, features=features).features, at_once)
