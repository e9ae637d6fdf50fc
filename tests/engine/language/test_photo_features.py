"""What is kept of the photos for later prompts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from taught_words import word_of

from fruitlangs.engine.errors import Cancelled, EncoderError, FormatError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.encoders.encoder import FruitView
from fruitlangs.engine.language.features.features import Features
from fruitlangs.engine.language.features.photo_features import (
    EARLIER,
    FORMAT,
    TENSORS,
    PhotoFeatures,
    PhotoFeaturesRecorder,
    load_photo_features,
    save_photo_features,
)
from fruitlangs.engine.language.prompts.photo_probability import photo_probabilities, prepare_photos
from fruitlangs.engine.language.prompts.relevancy import relevancy
from fruitlangs.engine.language.taught.word import TaughtWord
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.storage.files import write_tensors


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
    recorder = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity)
    for photo in photos:
        recorder.keep(FruitView(photo, offsets_of(photo), torch.zeros(*photo.shape[:2], 0)), pixels_of(photo), (0.75,))
    return recorder.collect()


def of_two(encoder: EmbeddedEncoder) -> PhotoFeatures:
    """What was kept of two photos."""
    return kept(encoder, photo_of(encoder), photo_of(encoder))


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
    ((_, places, colours),) = kept(encoder, photo).iterate_colours()
    whole = pixels_of(photo)[::2, ::2].reshape(-1, 3)
    assert np.array_equal((colours * 255.0).round().numpy(), whole[places])


def test_only_pixels_that_may_be_fruit_are_kept(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    assert kept(encoder, photo, photo).counts.tolist() == [12, 12]


def test_what_was_seen_of_large_photos_is_kept_in_full(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder, height=40, width=960)
    after = kept(encoder, photo)
    assert after.shapes.tolist() == [[40, 960]]
    assert after.counts.tolist() == [480 + 960]


def test_words_for_other_objects_have_no_maps(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    assert photo_probabilities(kept(encoder, photo), features_of(encoder, photo), encoder, ["bucket"]) is None


def test_what_is_written_is_read(encoder: EmbeddedEncoder, tmp_path: Path) -> None:
    before = kept(encoder, photo_of(encoder), photo_of(encoder, 5, 4) * 0.0)
    save_photo_features(tmp_path / "photos.safetensors", before)
    after = load_photo_features(tmp_path / "photos.safetensors")
    for name in TENSORS:
        assert torch.equal(getattr(before, name), getattr(after, name))
    assert after.encoder_id == encoder.fruit_identity


@pytest.mark.parametrize("scales", [[(0.5,), (1.25, 0.625)], [(), (2.0,)], [(), ()]])
def test_the_scales_of_photos_are_kept_and_read_back(
    encoder: EmbeddedEncoder, tmp_path: Path, scales: list[tuple[float, ...]]
) -> None:
    recorder, photo = PhotoFeaturesRecorder(encoder.kinds(), encoder.fruit_identity), photo_of(encoder)
    for own in scales:
        view = FruitView(photo, offsets_of(photo), torch.zeros(*photo.shape[:2], 0))
        recorder.keep(view, pixels_of(photo), own)
    save_photo_features(tmp_path / "photos.safetensors", recorder.collect())
    assert load_photo_features(tmp_path / "photos.safetensors").seen_at == scales


def test_no_photos_have_no_scales(encoder: EmbeddedEncoder, tmp_path: Path) -> None:
    save_photo_features(tmp_path / "photos.safetensors", kept(encoder))
    assert load_photo_features(tmp_path / "photos.safetensors").seen_at == []


@pytest.mark.parametrize(
    "scales",
    [
        torch.ones(2),
        torch.ones(1, 1),
        torch.ones(2, 1, dtype=torch.float64),
        torch.full((2, 1), -0.5),
        torch.full((2, 1), torch.nan),
        torch.full((2, 1), 2.5),
    ],
)
def test_damaged_scales_are_refused(encoder: EmbeddedEncoder, tmp_path: Path, scales: torch.Tensor) -> None:
    path = tmp_path / "photos.safetensors"
    save_photo_features(path, replace(kept(encoder, photo_of(encoder), photo_of(encoder)), scales=scales))
    with pytest.raises(FormatError, match=r"its tensors do not fit.*Count again"):
        load_photo_features(path)


def test_a_file_of_an_earlier_version_is_read_without_scales(encoder: EmbeddedEncoder, tmp_path: Path) -> None:
    before, path = kept(encoder, photo_of(encoder), photo_of(encoder)), tmp_path / "photos.safetensors"
    tensors = {name: getattr(before, name) for name in TENSORS if name != "scales"}
    write_tensors(path, tensors, {"format": EARLIER, "encoder_id": before.encoder_id})
    after = load_photo_features(path)
    assert after.seen_at == [(), ()]
    assert torch.equal(after.values, before.values)


@pytest.mark.parametrize("format_", [FORMAT, "fruitlangs-photo-features-2"])
def test_a_file_without_scales_that_should_have_them_is_refused(
    encoder: EmbeddedEncoder, tmp_path: Path, format_: str
) -> None:
    before, path = kept(encoder, photo_of(encoder)), tmp_path / "photos.safetensors"
    tensors = {name: getattr(before, name) for name in TENSORS if name != "scales"}
    write_tensors(path, tensors, {"format": format_, "encoder_id": before.encoder_id})
    with pytest.raises(FormatError, match="Count again"):
        load_photo_features(path)


def test_features_of_photos_by_other_weights_are_refused(encoder: EmbeddedEncoder) -> None:
    photo = photo_of(encoder)
    other = replace(kept(encoder, photo), encoder_id=encoder.identity)
    with pytest.raises(EncoderError, match="Count again from the photos"):
        photo_probabilities(other, features_of(encoder, photo), encoder, ["apple"])


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


SEEN_AT: list[tuple[float, ...]] = []
"""The scales at which `Seeing` saw each photo."""


class Seeing(EmbeddedEncoder):
    """An encoder that takes every pixel for a leaf, whose embedding is the colour."""

    def encode_fruit(self, image: NDArray[np.uint8], scales: Sequence[float] = ()) -> FruitView:
        SEEN_AT.append(tuple(scales))
        leaf, green = self.encode_text(["leaf", "green"])
        features = ((leaf + green) / 2**0.5).expand(*image.shape[:2], -1)
        return FruitView(features, torch.full((*image.shape[:2], 2), 0.5), torch.from_numpy(image / 255.0).float())


@pytest.fixture
def fig(encoder: EmbeddedEncoder) -> TaughtWord:
    """What is blue."""
    return word_of("fig", -20.0, 0.0, 20.0, bias=-10.0, encoder_id=encoder.identity)


@pytest.fixture
def seeing(encoder: EmbeddedEncoder, fig: TaughtWord) -> Seeing:
    return Seeing(encoder.network, encoder.calibration, encoder.identity, {"fig": fig})


def tree_of(mask: NDArray[np.bool_] | None = None, height: int = 6, width: int = 8) -> Scene:
    """Two photos with a blue row 2, of which the second can be masked."""
    picture = np.full((height, width, 3), 60, np.uint8)
    picture[2] = [0, 0, 255]
    camera = Camera(np.diag([8.0, 8.0, 1.0]), np.eye(4), width, height)
    photos = [ArrayPhoto("a.png", picture), ArrayPhoto("b.png", picture, mask)]
    return Scene([camera] * 2, photos, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.array([0.0, -1.0, 0.0]))


@pytest.mark.parametrize(("prompts", "negatives"), [(["apple"], []), (["red apple", "pear"], ["leaf"])])
def test_prompts_without_a_taught_word_use_what_was_kept(
    encoder: EmbeddedEncoder, seeing: Seeing, prompts: list[str], negatives: list[str]
) -> None:
    before = kept(encoder, photo_of(encoder))
    features = features_of(encoder, photo_of(encoder))
    for scene in (tree_of(), replace(tree_of(), images=[])):
        assert prepare_photos(before, scene, features, seeing, prompts, negatives) is before


def test_for_a_taught_word_the_pixels_of_its_fruit_are_kept(encoder: EmbeddedEncoder, seeing: Seeing) -> None:
    before = kept(encoder, photo_of(encoder), photo_of(encoder))
    features = replace(features_of(encoder, photo_of(encoder)), embedding=torch.zeros(48, 3).half())
    mask = np.ones((6, 8), bool)
    mask[:, :3] = False
    after = prepare_photos(before, tree_of(mask), features, seeing, ["figs"])
    assert after is not None
    assert after.places.tolist() == [*range(16, 24), *range(19, 24)]
    assert after.counts.tolist() == [8, 5]
    assert after.embedding is not None
    assert after.embedding[0].tolist() == [0.0, 0.0, 1.0]
    first, second = photo_probabilities(after, features, seeing, ["figs"]) or []
    assert first.probability[2].min() > 0.99
    assert second.probability[2, :3].max() == first.probability[[0, 1, 3, 4, 5]].max() == 0.0
    assert first.offsets[2, 0].tolist() == [0.5, 0.5]


def test_for_a_taught_word_photos_are_seen_again_at_the_scales_at_which_they_were_seen(
    encoder: EmbeddedEncoder, seeing: Seeing
) -> None:
    before = kept(encoder, photo_of(encoder), photo_of(encoder))
    before = replace(before, scales=torch.tensor([[0.5, 0.25], [1.5, 0.0]]))
    features = replace(features_of(encoder, photo_of(encoder)), embedding=torch.zeros(48, 3).half())
    SEEN_AT.clear()
    after = prepare_photos(before, tree_of(), features, seeing, ["fig"])
    assert after is not None
    assert SEEN_AT == after.seen_at == [(0.5, 0.25), (1.5,)]


def test_a_taught_negative_is_searched_in_the_photos_too(encoder: EmbeddedEncoder, seeing: Seeing) -> None:
    features = replace(features_of(encoder, photo_of(encoder)), embedding=torch.zeros(48, 3).half())
    whole = replace(seeing, taught={**seeing.taught, "plum": word_of("plum", 0.0, 0.0, 0.0, bias=9.0)})
    after = prepare_photos(of_two(encoder), tree_of(), features, whole, ["plum"], ["fig"])
    assert after is not None
    assert after.counts.tolist() == [48, 48]
    first, _ = photo_probabilities(after, features, whole, ["plum"], ["fig"]) or []
    assert first.probability[2].max() < 0.01
    assert first.probability[0].min() > 0.8


def test_photos_that_are_missing_cannot_be_searched_for_a_taught_word(encoder: EmbeddedEncoder, seeing: Seeing) -> None:
    before = kept(encoder, photo_of(encoder))
    features = replace(features_of(encoder, photo_of(encoder)), embedding=torch.zeros(48, 3).half())
    missing = replace(tree_of(), images=[])
    assert prepare_photos(before, missing, features, seeing, ["fig"]) is None
    assert prepare_photos(before, missing, features, seeing, ["apple"], ["fig"]) is None


def test_the_search_for_a_taught_word_can_be_cancelled(encoder: EmbeddedEncoder, seeing: Seeing) -> None:
    seen: list[float] = []

    def progress(share: float, _: str) -> None:
        seen.append(share)
        raise Cancelled

    features = replace(features_of(encoder, photo_of(encoder)), embedding=torch.zeros(48, 3).half())
    with pytest.raises(Cancelled):
        prepare_photos(of_two(encoder), tree_of(), features, seeing, ["fig"], progress=progress)
    assert seen == [0.5]
