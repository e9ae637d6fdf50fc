"""Codes of three numbers from which features come back."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from fruitlangs.engine.config import EmbedConfig
from fruitlangs.engine.errors import Cancelled, EncoderError
from fruitlangs.engine.language.features import autoencoder
from fruitlangs.engine.language.features.autoencoder import reconstruction_loss, train_autoencoder, train_autoencoders

QUICK = EmbedConfig(code_epochs=12)


def kinds(count: int = 4, dimension: int = 24) -> Tensor:
    """(count, dimension) unit vectors of kinds of objects."""
    return functional.normalize(torch.randn(count, dimension, generator=torch.Generator().manual_seed(1)), dim=-1)


def masks(many: int = 600, seed: int = 0) -> Tensor:
    """(many, D) unit features of masks, near the vector of their kind, mask k of kind k mod 4."""
    generator = torch.Generator().manual_seed(seed)
    near = kinds()[torch.arange(many) % 4] + 0.05 * torch.randn(many, 24, generator=generator)
    return functional.normalize(near, dim=-1)


def test_features_come_back_and_can_be_distinguished():
    trained = train_autoencoder(masks(), QUICK)
    unseen = masks(100, seed=7)
    codes = trained.encode(unseen)
    assert codes.shape == (100, 3)
    assert torch.allclose(codes.norm(dim=1), torch.ones(100), atol=1e-5)
    back = trained.decode(codes)
    assert torch.allclose(back.norm(dim=1), torch.ones(100), atol=1e-5)
    assert torch.equal((back @ kinds().T).argmax(1), torch.arange(100) % 4)


def test_the_error_that_is_reported_is_that_of_the_result():
    features = masks()
    trained = train_autoencoder(features, QUICK)
    back = trained.decode(trained.encode(features))
    assert trained.cosine == pytest.approx(float((back * features).sum(1).mean()), abs=1e-6)
    assert trained.l1 == pytest.approx(float((back - features).abs().mean()), abs=1e-6)
    assert 0.8 < trained.cosine < 1.0
    assert trained.learnt == 600


def test_the_layers_are_the_papers():
    trained = train_autoencoder(functional.normalize(torch.rand(8, 512)), EmbedConfig(code_epochs=1))
    assert [weight.shape[0] for weight in trained.encode.weights] == [256, 128, 64, 32, 3]
    assert [weight.shape[0] for weight in trained.decode.weights] == [16, 32, 64, 128, 256, 256, 512]


def test_the_cosine_of_the_loss_runs_over_the_feature_axis():
    given, back = torch.tensor([[1.0, 0.0], [0.0, 1.0]]), torch.tensor([[0.0, 1.0], [0.0, 1.0]])
    assert float(reconstruction_loss(back, given)) == pytest.approx(0.5 + 0.5)


def test_the_same_seed_gives_the_same_bytes_and_another_does_not():
    first, again = (train_autoencoder(masks(), EmbedConfig(code_epochs=2)) for _ in range(2))
    other = train_autoencoder(masks(), EmbedConfig(code_epochs=2, seed=1))
    assert all(torch.equal(*pair) for pair in zip(first.decode.weights, again.decode.weights, strict=True))
    assert not torch.equal(first.decode.weights[0], other.decode.weights[0])


def test_more_features_than_the_bound_are_thinned_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(autoencoder, "MOST_VECTORS", 100)
    assert train_autoencoder(masks(), EmbedConfig(code_epochs=1)).learnt == 100


def test_one_autoencoder_serves_all_levels_or_each_has_its_own():
    levels = [masks(80), masks(40, seed=1), masks(20, seed=2)]
    (one,) = train_autoencoders(levels, EmbedConfig(code_epochs=1))
    assert one.learnt == 140
    each = train_autoencoders(levels, EmbedConfig(code_epochs=1, code_each_level=True))
    assert [trained.learnt for trained in each] == [80, 40, 20]


def test_no_feature_to_learn_from_is_refused():
    with pytest.raises(EncoderError, match="No mask"):
        train_autoencoder(torch.zeros(0, 24), QUICK)


def test_a_feature_that_is_no_number_is_refused():
    features = masks()
    features[3, 4] = math.nan
    with pytest.raises(EncoderError, match="not a number"):
        train_autoencoder(features, QUICK)


def test_learning_can_be_cancelled_between_epochs():
    told: list[str] = []

    def stop(fraction: float, message: str) -> None:
        told.append(message)
        if fraction > 0.1:
            raise Cancelled

    with pytest.raises(Cancelled):
        train_autoencoder(masks(), QUICK, progress=stop)
    assert told == ["learning codes, epoch 1 of 12", "learning codes, epoch 2 of 12", "learning codes, epoch 3 of 12"]
