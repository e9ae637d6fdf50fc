"""Where on its fruit each pixel lies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fruitlangs.engine.errors import EncoderError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.encoders.offsets import OffsetNetwork, load_offsets, offsets_identity, save_offsets
from fruitlangs.engine.language.encoders.seen import resize, see
from fruitlangs.fitting.encoder.offset_learning import OffsetPicture, learn_offsets

SIDE, MIDDLE, RADIUS = 160, np.array([70.0, 90.0]), 18.0


@pytest.fixture(scope="module")
def encoder() -> EmbeddedEncoder:
    return EmbeddedEncoder.open()


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    """(SIDE, SIDE, 2) of each pixel, in radii from the middle of the ball."""
    down, right = np.mgrid[:SIDE, :SIDE] + 0.5
    return (np.stack([right, down], axis=-1) - MIDDLE) / RADIUS


@pytest.fixture(scope="module")
def ball(places: np.ndarray) -> np.ndarray:
    """A red ball lit from above before rough green."""
    rng = np.random.default_rng(0)
    picture = np.array([60.0, 105.0, 45.0]) * rng.uniform(0.5, 1.3, (SIDE // 8, SIDE // 8, 1)).repeat(8, 0).repeat(8, 1)
    square = (places**2).sum(axis=-1)
    towards = np.sqrt(np.maximum(1.0 - square, 0.0))
    light = np.clip(0.35 + 0.4 * towards - 0.35 * places[..., 1], 0.0, 1.2)[..., None]
    shown = np.where(square[..., None] < 1.0, np.array([205.0, 45.0, 40.0]) * light, picture)
    return np.clip(shown, 0, 255).astype(np.uint8)


def test_offsets_lead_from_the_pixels_of_a_ball_to_its_middle(
    encoder: EmbeddedEncoder, ball: np.ndarray, places: np.ndarray
) -> None:
    offsets = encoder.encode_fruit(ball).offsets
    inside = (places**2).sum(axis=-1) < 0.8
    errors = np.linalg.norm(offsets.numpy() - places, axis=-1)[inside]
    assert np.median(errors) < 0.25


def test_features_are_the_same_with_offsets_and_without(encoder: EmbeddedEncoder, ball: np.ndarray) -> None:
    view = encoder.encode_fruit(ball)
    assert torch.equal(view.features, encoder.encode_dense(ball))
    assert view.offsets.shape == (SIDE, SIDE, 2)
    assert view.embedding.shape == (SIDE, SIDE, encoder.embedding_size)


def test_large_photos_have_offsets_of_their_features_size(encoder: EmbeddedEncoder) -> None:
    view = encoder.encode_fruit(np.full((60, 2000, 3), 90, np.uint8))
    assert view.features.shape[:2] == view.offsets.shape[:2] == view.embedding.shape[:2] == (14, 480)


def test_offsets_of_a_large_ball_lead_to_its_middle_at_the_scale_for_its_width(
    encoder: EmbeddedEncoder, ball: np.ndarray, places: np.ndarray
) -> None:
    large = ball.repeat(3, axis=0).repeat(3, axis=1)
    scales = encoder.scales_of(*large.shape[:2], 6.0 * RADIUS)
    offsets = encoder.encode_fruit(large, scales).offsets.permute(2, 0, 1)
    assert offsets.shape[1:] == (98, 98)
    inside = (places**2).sum(axis=-1) < 0.8
    errors = np.linalg.norm(resize(offsets, SIDE, SIDE).permute(1, 2, 0).numpy() - places, axis=-1)[inside]
    assert np.median(errors) < 0.25


def test_offsets_at_several_scales_are_averaged_by_their_errors(encoder: EmbeddedEncoder, ball: np.ndarray) -> None:
    pixels, network = torch.from_numpy(ball).permute(2, 0, 1).float() / 255.0, load_offsets(encoder.identity)
    found = [see(encoder.network, pixels, scale, network).offsets for scale in (2.0, 1.0)]
    (fine, fine_error), (coarse, coarse_error) = (
        resize(each, SIDE, SIDE).split((2, 1)) for each in found if each is not None
    )
    weights = [torch.exp(error).square().reciprocal() for error in (fine_error, coarse_error)]
    expected = (weights[0] * fine + weights[1] * coarse) / (weights[0] + weights[1])
    shown = encoder.encode_fruit(ball, (2.0, 1.0)).offsets.permute(2, 0, 1)
    torch.testing.assert_close(shown, expected, atol=1e-3, rtol=0.0)


def test_weights_for_another_encoder_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "offsets.safetensors"
    save_offsets(path, OffsetNetwork(), "one")
    assert load_offsets("one", path).training is False
    with pytest.raises(EncoderError, match=r"fit_offsets\.py"):
        load_offsets("other", path)


def test_the_identity_of_what_an_encoder_sees_of_fruit_names_both_of_its_networks(encoder: EmbeddedEncoder) -> None:
    assert encoder.fruit_identity == f"{encoder.identity}+{offsets_identity()}"


def test_the_identity_of_offsets_changes_with_their_weights(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("one", "same", "other")]
    network = OffsetNetwork()
    for path, encoder in zip(paths, ("a", "a", "b"), strict=True):
        save_offsets(path, network, encoder)
    one, same, other = map(offsets_identity, paths)
    assert one == same != other


def test_the_identity_of_missing_offsets_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(EncoderError, match="Install the package again"):
        offsets_identity(tmp_path / "gone")


@pytest.mark.parametrize("content", [b"", b"nothing"])
def test_damaged_weights_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "offsets.safetensors"
    path.write_bytes(content)
    with pytest.raises(EncoderError, match="Install the package again"):
        load_offsets("one", path)


def test_training_on_begins_with_the_weights_that_are_given(encoder: EmbeddedEncoder, ball: np.ndarray) -> None:
    picture = OffsetPicture(ball, np.ones((SIDE, SIDE), bool), *np.ones((2, SIDE, SIDE, 2), np.float32))
    start = OffsetNetwork()
    before = {name: tensor.clone() for name, tensor in start.state_dict().items()}
    after = learn_offsets(encoder.network, [picture], [], steps=0, seed=1, start=start).state_dict()
    assert all(torch.equal(tensor, after[name]) for name, tensor in before.items())
