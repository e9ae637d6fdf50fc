"""What is kept of the photos for later prompts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.features.photo_features import (
    MOST_SIDE,
    TENSORS,
    PhotoFeatures,
    PhotoFeaturesRecorder,
    load_photo_features,
    save_photo_features,
)
from fruitlangs.engine.language.prompts.photo_probability import photo_probabilities
from fruitlangs.engine.language.prompts.relevancy import relevancy


@pytest.fixture(scope="module")
def encoder() -> EmbeddedEncoder:
    return EmbeddedEncoder.open()


def photo_of(encoder: EmbeddedEncoder, height: int = 6, width: int = 8) -> torch.Tensor:
    """Leaves, with an apple in the left half of row 2 and an uncertain one in row 4."""
    leaf, apple, red, green = encoder.encode_text(["leaf", "apple", "red", "green"])
    photo = ((leaf + green) / 2**0.5).expand(height, width, -1).clone()
    photo[2, : width // 2] = (apple + red) / 2**0.5
    photo[4] = (0.6 * apple**2 + 0.4 * leaf**2 + red**2).sqrt() / 2**0.5
    return photo


def kept(encoder: EmbeddedEncoder, *photos: torch.Tensor) -> PhotoFeatures:
    recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.identity)
    for photo in photos:
        recorder.keep(photo, offsets_of(photo), pixels_of(photo))
    return recorder.kept()


def offsets_of(photo: torch.Tensor) -> torch.Tensor:
    """A different offset for every pixel."""
    height, width = photo.shape[:2]
    down, right = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
    return torch.stack([right, down], dim=-1)


def pixels_of(photo: torch.Tensor) -> np.ndarray:
    """Twice as large: each pixel of a feature has a colour that tells its row and column."""
    height, width = photo.shape[:2]
    down, right = np.mgrid[:height, :width]
    return np.stack([down, right, right + down], axis=-1).astype(np.uint8).repeat(2, axis=0).repeat(2, axis=1)


def features_of(encoder: EmbeddedEncoder, photo: torch.Tensor) -> Features:
    """The pixels as Gaussians."""
    vectors = photo.reshape(-1, 1, photo.shape[-1])
    ones = torch.ones(len(vectors), 1)
    return Features(vectors, ones, ones, encoder.identity)


@pytest.mark.parametrize("prompts", [["apple"], ["fruit"], ["red apple"], ["apple", "pear"]])
def test_a_pixel_is_as_probable_as_a_gaussian_with_its_feature(encoder: EmbeddedEncoder, prompts: list[str]) -> None:
    photo = photo_of(encoder)
    features = features_of(encoder, photo)
    maps = photo_probabilities(kept(encoder, photo), features, encoder, prompts, ["plum"])
    assert maps is not None
    expected = relevancy(features, encoder, prompts, ["plum"]).reshape(6, 8)
    shown = torch.from_numpy(maps[0].probability)
    assert torch.allclose(shown[2], expected[2], atol=0.02)
    assert torch.allclose(shown[4], expected[4], atol=0.02)
    assert shown[0].max() == 0.0


def test_the_offset_of_a_pixel_is_kept_with_it(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    maps = photo_probabilities(kept(encoder, photo), features_of(encoder, photo), encoder, ["apple"])
    assert maps is not None
    fruit = maps[0].probability > 0.0
    assert np.abs(maps[0].offsets - offsets_of(photo).numpy())[fruit].max() < 0.01


def test_the_colour_of_a_pixel_is_kept_with_it(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    ((_, places, colours),) = kept(encoder, photo).coloured()
    whole = pixels_of(photo)[::2, ::2].reshape(-1, 3)
    assert np.array_equal((colours * 255.0).round().numpy(), whole[places])


def test_only_pixels_that_may_be_fruit_are_kept(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    assert kept(encoder, photo, photo).counts.tolist() == [12, 12]


def test_large_photos_are_kept_smaller(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder, height=40, width=2 * MOST_SIDE)
    assert kept(encoder, photo).shapes.tolist() == [[20, MOST_SIDE]]


def test_words_for_other_objects_have_no_maps(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    assert photo_probabilities(kept(encoder, photo), features_of(encoder, photo), encoder, ["bucket"]) is None


def test_what_is_written_is_read(encoder: EmbeddedEncoder, tmp_path: Path) -> None:
    before = kept(encoder, photo_of(encoder), photo_of(encoder, 5, 4) * 0.0)
    save_photo_features(tmp_path / "photos.safetensors", before)
    after = load_photo_features(tmp_path / "photos.safetensors")
    for name in TENSORS:
        assert torch.equal(getattr(before, name), getattr(after, name))
    assert after.encoder_id == encoder.identity


@pytest.mark.parametrize("content", [b"", b"nothing", None])
def test_a_damaged_file_is_refused(encoder: EmbeddedEncoder, tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "photos.safetensors"
    if content is None:
        broken = kept(encoder, photo_of(encoder))
        broken.places[0] = 10_000
        save_photo_features(path, broken)
    else:
        path.write_bytes(content)
    with pytest.raises(FormatError, match="Count again"):
        load_photo_features(path)
