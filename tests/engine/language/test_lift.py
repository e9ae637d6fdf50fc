"""Features of pixels reach the Gaussians that drew them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.language.encoders.encoder import FruitView
from fruitlangs.engine.language.features import lift
from fruitlangs.engine.language.features.lift import encode_photos, lift_features
from fruitlangs.engine.language.features.photo_features import PhotoFeaturesRecorder
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.splatting.gaussians import Gaussians

SIDE = 32


def _camera() -> Camera:
    K = np.array([[SIDE, 0.0, SIDE / 2], [0.0, SIDE, SIDE / 2], [0.0, 0.0, 1.0]])
    return Camera(K, np.eye(4), SIDE, SIDE)


def _gaussians(*means: tuple[float, float, float]) -> Gaussians:
    n = len(means)
    return Gaussians(
        means=torch.tensor(means),
        log_scales=torch.full((n, 3), 0.06).log(),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        opacity_logits=torch.full((n,), 4.0),
        sh=torch.zeros(n, 1, 3),
    )


def _halves() -> Tensor:
    """Left half (1, 0), right half (0, 1)."""
    target = torch.zeros(SIDE, SIDE, 2)
    target[:, : SIDE // 2, 0] = 1.0
    target[:, SIDE // 2 :, 1] = 1.0
    return target


LEFT, RIGHT, BEHIND = (-0.25, 0.0, 1.0), (0.25, 0.0, 1.0), (0.0, 0.0, -1.0)


def test_each_gaussian_gets_the_feature_of_its_pixels():
    features = lift_features(_gaussians(LEFT, RIGHT), [_camera()], [_halves()], encoder_id="x")
    assert torch.allclose(features.unit(0), torch.eye(2), atol=1e-3)
    assert (features.weights > 5.0).all()
    assert features.encoder_id == "x"


def test_views_are_averaged_and_normalised():
    swapped = _halves().flip(-1)
    features = lift_features(_gaussians(LEFT), [_camera()] * 2, [_halves(), swapped], encoder_id="x")
    assert torch.allclose(features.unit(0)[0], torch.full((2,), 0.5**0.5), atol=1e-3)


def test_a_gaussian_that_no_view_sees_has_weight_and_feature_zero():
    features = lift_features(_gaussians(LEFT, BEHIND), [_camera()], [_halves()], encoder_id="x")
    assert float(features.weights[1]) == 0.0
    assert not features.unit(0)[1].any()


def test_masked_pixels_count_for_nothing():
    masked = _halves()
    masked[:, : SIDE // 2] = 0.0
    features = lift_features(_gaussians(LEFT), [_camera()] * 2, [_halves(), masked], encoder_id="x")
    once = lift_features(_gaussians(LEFT), [_camera()], [_halves()], encoder_id="x")
    assert torch.allclose(features.unit(0), once.unit(0), atol=1e-5)
    assert torch.allclose(features.weights, once.weights, rtol=1e-4)


def test_a_target_of_another_size_is_refused():
    with pytest.raises(SceneError, match="view 0 are 16×32"):
        lift_features(_gaussians(LEFT), [_camera()], [_halves()[:, :16]], encoder_id="x")


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_channels_that_are_gathered_a_few_at_a_time_give_the_same_features(
    monkeypatch: pytest.MonkeyPatch, channels: int, masked: bool
):
    target = torch.rand(SIDE, SIDE, 5, generator=torch.Generator().manual_seed(0))
    if masked:
        target[: SIDE // 2] = 0.0
    given = (_gaussians(LEFT, RIGHT), [_camera()], [target])
    at_once = lift_features(*given, encoder_id="x", embedded=2)
    monkeypatch.setattr(lift, "MOST_VALUES", channels * SIDE * SIDE)
    gathered = lift_features(*given, encoder_id="x", embedded=2)
    for name in ("vectors", "weights", "agreement", "embedding"):
        assert torch.equal(getattr(gathered, name), getattr(at_once, name))


@pytest.mark.parametrize("count", [1, 3])
def test_as_many_targets_as_cameras_are_needed(count: int):
    with pytest.raises(SceneError, match="views"):
        lift_features(_gaussians(LEFT), [_camera()] * 2, [_halves()] * count, encoder_id="x")


def test_an_embedding_is_averaged_and_not_normalised():
    embedding = torch.full((SIDE, SIDE, 3), 3.0)
    embedding[:, SIDE // 2 :] = -5.0
    views = [torch.cat([_halves(), scale * embedding], dim=-1) for scale in (1.0, 2.0)]
    features = lift_features(_gaussians(LEFT, RIGHT, BEHIND), [_camera()] * 2, views, encoder_id="x", embedded=3)
    assert features.embedding is not None
    assert features.embedding.dtype == torch.float16
    means = torch.tensor([4.5, -7.5, 0.0])[:, None].expand(3, 3)
    assert torch.allclose(features.embedding.float(), means, atol=0.05)
    alone = lift_features(_gaussians(LEFT, RIGHT, BEHIND), [_camera()] * 2, [_halves()] * 2, encoder_id="x")
    assert alone.embedding is None
    for name in ("vectors", "weights", "agreement"):
        assert torch.allclose(getattr(features, name), getattr(alone, name), atol=1e-5)


def test_the_embedding_of_masked_pixels_counts_for_nothing():
    shown = torch.cat([_halves(), torch.full((SIDE, SIDE, 1), 3.0)], dim=-1)
    views = [shown, torch.zeros_like(shown)]
    features = lift_features(_gaussians(LEFT), [_camera()] * 2, views, encoder_id="x", embedded=1)
    assert features.embedding is not None
    assert float(features.embedding) == pytest.approx(3.0, abs=0.01)


class _Brightness:
    """An encoder of half the photo's size that tells dark from bright."""

    identity = "brightness"
    dimension = 2

    def encode_dense(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> Tensor:
        self.scales = scales
        bright = torch.from_numpy(image[::2, ::2, 0] > 127).float()
        return torch.stack([bright, 1.0 - bright], dim=-1)


def test_photos_are_encoded_with_their_masks_at_the_encoders_size():
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    image[:, SIDE // 2 :] = 255
    mask = np.ones((SIDE, SIDE), bool)
    mask[:5] = False
    photo = ArrayPhoto("a.png", image, mask)
    scene = Scene([_camera()], [photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.array([0.0, 0.0, 1.0]))
    (target,) = encode_photos(scene, _Brightness(), [()])  # type: ignore[arg-type]
    assert target.shape == (SIDE // 2, SIDE // 2, 2)
    assert not target[:3].any()  # the third row of the smaller picture is half masked
    assert target[3, 2].tolist() == [0.0, 1.0]
    assert target[3, -2].tolist() == [1.0, 0.0]


class _Seeing(_Brightness):
    """It also tells how red a pixel is, as the embedding."""

    embedding_size = 1

    def encode_fruit(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> FruitView:
        features = self.encode_dense(image, scales)
        red = torch.from_numpy(image[::2, ::2, :1] / 255.0).float()
        return FruitView(features, torch.zeros(*features.shape[:2], 2), red + 1.0)


def test_photos_are_encoded_with_the_embedding_after_their_features():
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    image[:, SIDE // 2 :] = 255
    mask = np.ones((SIDE, SIDE), bool)
    mask[:4] = False
    photo = ArrayPhoto("a.png", image, mask)
    scene = Scene([_camera()], [photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.array([0.0, 0.0, 1.0]))
    (target,) = encode_photos(scene, _Seeing(), [()], embedded=True)  # type: ignore[arg-type]
    assert target.shape == (SIDE // 2, SIDE // 2, 3)
    assert not target[:2].any()
    assert target[3, 2].tolist() == [0.0, 1.0, 1.0]
    assert target[3, -2].tolist() == [1.0, 0.0, 2.0]
    (plain,) = encode_photos(scene, _Seeing(), [()])  # type: ignore[arg-type]
    assert torch.equal(plain, target[..., :2])
    recorder = PhotoFeaturesRecorder(torch.eye(2), "x")
    (recorded,) = encode_photos(scene, _Seeing(), [()], recorder)  # type: ignore[arg-type]
    assert torch.equal(recorded, plain)


@pytest.mark.parametrize("recorded", [False, True])
def test_each_photo_is_encoded_at_its_own_scales(recorded: bool):
    photos = [ArrayPhoto(name, np.zeros((SIDE, SIDE, 3), np.uint8)) for name in ("a.png", "b.png")]
    scene = Scene([_camera()] * 2, photos, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.array([0.0, 0.0, 1.0]))
    encoder, scales = _Seeing(), [(0.75, 0.375), (1.5,)]
    recorder = PhotoFeaturesRecorder(torch.eye(2), "x") if recorded else None
    views = encode_photos(scene, encoder, scales, recorder)  # type: ignore[arg-type]
    assert [encoder.scales for _ in views] == scales
    if recorder is not None:
        assert recorder.collect().seen_at == scales


def test_as_many_scales_as_photos_are_needed():
    scene = Scene([], [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.array([0.0, 0.0, 1.0]))
    with pytest.raises(ValueError, match="zip"):
        list(encode_photos(scene, _Brightness(), [()]))  # type: ignore[arg-type]


def test_a_picture_that_is_smaller_on_one_side_alone_by_rounding_is_as_good_as_the_cameras():
    half = _halves()[:-1].contiguous()
    features = lift_features(_gaussians(LEFT, RIGHT), [_camera()], [half], encoder_id="x")
    assert torch.allclose(features.unit(0), torch.eye(2), atol=1e-3)


def test_features_of_a_smaller_picture_count_as_the_pixels_of_the_camera():
    whole = lift_features(_gaussians(LEFT, BEHIND), [_camera()], [_halves()], encoder_id="x")
    half = lift_features(_gaussians(LEFT, BEHIND), [_camera()], [_halves()[::2, ::2].contiguous()], encoder_id="x")
    # Drawn smaller, a Gaussian is widened more: 0.3 square pixels are added to its variance at any size.
    assert torch.allclose(half.weights, whole.weights, rtol=0.25)
    assert torch.allclose(half.unit(0), whole.unit(0), atol=0.01)


def test_agreement_is_the_mean_cosine_of_the_views_to_the_feature():
    swapped = _halves().flip(-1)
    features = lift_features(_gaussians(LEFT, BEHIND), [_camera()] * 2, [_halves(), swapped], encoder_id="x")
    assert float(features.agreement[0, 0]) == pytest.approx(0.5**0.5, abs=1e-3)
    assert float(features.agreement[1, 0]) == 0.0
    agreed = lift_features(_gaussians(LEFT), [_camera()] * 2, [_halves()] * 2, encoder_id="x")
    assert float(agreed.agreement[0, 0]) == pytest.approx(1.0, abs=1e-4)
