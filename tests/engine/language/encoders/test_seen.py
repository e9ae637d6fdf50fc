"""At which scales the network sees a photo, and that neither tiles nor skimming change what it says about fruit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from fruitlangs.engine.language.encoders import embedded, seen
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.encoders.network import STRIDE
from fruitlangs.engine.language.encoders.offsets import load_offsets
from fruitlangs.engine.language.encoders.seen import (
    MOST_PIXELS,
    SIDE,
    Skimmed,
    map_size,
    resize,
    scales_of,
    see,
    tiles_of,
)

PHOTO = Path(__file__).resolve().parents[4] / "examples" / "orchard_tree" / "images" / "001.jpg"


@pytest.fixture(scope="module")
def encoder() -> EmbeddedEncoder:
    return EmbeddedEncoder.open()


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    """Wider than high, with a number of rows and of columns that no stride divides."""
    return np.asarray(Image.open(PHOTO).convert("RGB"))[60:299, 80:401]


@pytest.fixture(scope="module")
def apples_in_a_corner(photo: np.ndarray) -> np.ndarray:
    """A part of a tree on grey that no fruit has."""
    picture = np.full((300, 420, 3), 128, np.uint8)
    picture[150:270, 20:180] = photo[60:180, 80:240]
    return picture


@pytest.fixture(scope="module")
def pixels(photo: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(photo.copy()).permute(2, 0, 1).float() / 255.0


@pytest.mark.parametrize("fruit", [15.5, 20.0, 30.0, 36.0])
def test_fruit_of_a_known_width_are_seen_30_pixels_wide_at_one_scale(fruit: float) -> None:
    (scale,) = scales_of(900, 1200, fruit)
    assert scale * fruit == pytest.approx(30.0)


@pytest.mark.parametrize(
    ("size", "fruit", "expected"), [((240, 320), 18.7, 2.0), ((240, 320), 40.0, 1.1), ((900, 1200), 70.0, 44 / 70)]
)
def test_photos_that_are_quickly_processed_are_seen_larger(
    size: tuple[int, int], fruit: float, expected: float
) -> None:
    """In small photos fruit are seen up to 44 pixels wide, so that those that are smaller than most are seen too."""
    assert scales_of(*size, fruit) == pytest.approx((expected,))


def test_the_scale_changes_steadily_with_the_size_of_the_photo() -> None:
    scales = [scales_of(3 * size, 4 * size, 20.0)[0] for size in range(60, 400)]
    assert max(abs(np.diff(np.log(scales)))) < 0.02
    assert scales == sorted(scales, reverse=True)


@pytest.mark.parametrize("fruit", [15.0, 13.0, 3.0])
def test_photos_of_small_fruit_are_enlarged_twice_and_not_more(fruit: float) -> None:
    assert scales_of(900, 1200, fruit) == (2.0,)


def test_the_image_that_is_seen_has_at_most_16_million_pixels() -> None:
    (scale,) = scales_of(4000, 6000, 14.0)
    assert 4000 * 6000 * scale**2 == pytest.approx(MOST_PIXELS)
    assert scales_of(1000, 6000, 30.0) == (1.0,)


@pytest.mark.parametrize(
    ("size", "scales"),
    [((360, 480), (2.0,)), ((480, 360), (2.0,)), ((720, 960), (1.0, 0.5)), ((3840, 2880), (0.25, 0.125))],
)
def test_photos_of_fruit_of_unknown_width_are_seen_at_960_pixels_a_side_and_at_half_of_that_unless_enlarged_twice(
    size: tuple[int, int], scales: tuple[float, ...]
) -> None:
    assert scales_of(*size) == scales
    assert max(size) * scales[0] == SIDE


@pytest.mark.parametrize(
    ("size", "scales", "expected"),
    [
        ((100, 200), (1.0,), (50, 100)),
        ((100, 200), (1.0, 0.5), (50, 100)),
        ((100, 200), (2.0,), (100, 200)),
        ((37, 23), (2.0,), (37, 23)),
        ((37, 23), (4.0,), (37, 23)),
        ((20, 2000), (0.01,), (1, 10)),
    ],
)
def test_a_map_is_half_as_large_as_the_largest_image_that_is_seen_and_no_larger_than_the_photo(
    size: tuple[int, int], scales: tuple[float, ...], expected: tuple[int, int]
) -> None:
    assert map_size(*size, scales) == expected


@given(
    top=st.integers(0, 5),
    left=st.integers(0, 5),
    tall=st.integers(1, 150),
    wide=st.integers(1, 150),
    most=st.integers(1, 8000),
)
def test_tiles_cover_a_part_of_an_image_exactly_once(top: int, left: int, tall: int, wide: int, most: int) -> None:
    top, left = STRIDE * top, STRIDE * left
    covered = np.zeros((top + tall + 3, left + wide + 3), int)
    for rows, columns in tiles_of(slice(top, top + tall), slice(left, left + wide), most):
        covered[rows, columns] += 1
        assert rows.start % STRIDE == columns.start % STRIDE == 0
        assert covered[rows, columns].size <= max(most, STRIDE**2)
    assert covered[top : top + tall, left : left + wide].min() == 1
    assert covered.sum() == tall * wide


def test_a_part_that_fits_one_tile_is_not_divided() -> None:
    part = slice(16, 90), slice(0, 131)
    assert list(tiles_of(*part, 80 * 144)) == [part]


@pytest.mark.parametrize("empty", [(slice(0, 0), slice(0, 0)), (slice(16, 16), slice(0, 32))])
def test_an_empty_part_has_no_tiles(empty: tuple[slice, slice]) -> None:
    assert list(tiles_of(*empty, 1000)) == []


@pytest.mark.parametrize("scale", [1.0, 1.7])
def test_seams_of_tiles_change_no_output(
    encoder: EmbeddedEncoder, photo: np.ndarray, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = encoder.encode_fruit(photo, (scale,))
    monkeypatch.setattr(seen, "TILE", 160 * 160)
    tiled = encoder.encode_fruit(photo, (scale,))
    for name in ("features", "offsets", "embedding"):
        torch.testing.assert_close(getattr(tiled, name), getattr(whole, name), atol=1e-4, rtol=0.0)


def test_a_photo_is_seen_in_more_than_one_tile_if_it_is_large(
    encoder: EmbeddedEncoder, pixels: torch.Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    shapes = []
    levels_of = seen.levels_of

    def noted(network: torch.nn.Module, image: torch.Tensor) -> list[torch.Tensor]:
        shapes.append(tuple(image.shape[1:]))
        return levels_of(network, image)

    monkeypatch.setattr(seen, "levels_of", noted)
    monkeypatch.setattr(seen, "MARGIN", 16)
    monkeypatch.setattr(seen, "TILE", 128 * 176)
    see(encoder.network, pixels, 1.0)
    assert shapes == [(144, 176), (144, 176), (128, 176), (128, 176)]


def test_outputs_of_an_odd_photo_cover_it_and_nothing_more(encoder: EmbeddedEncoder, photo: np.ndarray) -> None:
    for scales in ((1.0,), (0.7, 0.35), (2.0,)):
        size = map_size(*photo.shape[:2], scales)
        view = encoder.encode_fruit(photo, scales)
        assert view.features.shape[:2] == view.offsets.shape[:2] == view.embedding.shape[:2] == size
        with torch.inference_mode():
            (first, *_) = encoder._process_scales(embedded._pixels(photo), scales, None)
        assert first.details.shape[1:] == size


def test_a_photo_is_seen_as_its_copy_at_that_size(encoder: EmbeddedEncoder, pixels: torch.Tensor) -> None:
    smaller = resize(pixels, 180, 240)
    own = see(encoder.network, pixels, 0.7501).details
    assert own.shape[1:] == (90, 120)
    torch.testing.assert_close(own, see(encoder.network, smaller, 1.0).details, atol=1e-4, rtol=0.0)


def test_a_picture_that_shrinks_is_averaged() -> None:
    stripes = torch.tensor([0.0, 1.0, 0.0, 0.0]).repeat(1, 8, 10)
    smaller = resize(stripes, 2, 10)
    torch.testing.assert_close(smaller[:, :, 1:-1], torch.full((1, 2, 8), 0.25), atol=0.03, rtol=0.0)


def test_only_what_is_close_to_possible_fruit_is_seen_at_full_size(
    encoder: EmbeddedEncoder, pixels: torch.Tensor
) -> None:
    offsets = load_offsets(encoder.identity)
    whole, half = (see(encoder.network, pixels, scale, offsets) for scale in (1.0, 0.5))
    assert whole.offsets is not None
    assert half.offsets is not None
    fruit = torch.zeros(half.details.shape[1:], dtype=torch.bool)
    fruit[28, 50], fruit[31, 56] = True, True
    part = see(encoder.network, pixels, 1.0, offsets, Skimmed(half, fruit))
    assert part.offsets is not None
    size = whole.details.shape[1:]
    # Outputs at half size show 4 × 4 pixels each, those at full size 2 × 2; 32 pixels to each side are close.
    top, left, bottom, right = (4 * 28 - 32) // 2, (4 * 50 - 32) // 2, (4 * 32 + 32) // 2, (4 * 57 + 32) // 2
    near = np.s_[:, top:bottom, left:right]
    far = torch.ones(size, dtype=torch.bool)
    far[top - STRIDE // 2 : bottom + STRIDE // 2, left - STRIDE // 2 : right + STRIDE // 2] = False
    pairs = (part.details, whole.details, half.details), (part.offsets, whole.offsets, half.offsets)
    for mixed, fine, coarse in pairs:
        torch.testing.assert_close(mixed[near], fine[near], atol=1e-4, rtol=0.0)
        torch.testing.assert_close(mixed[:, far], resize(coarse, *size)[:, far], atol=0.0, rtol=0.0)


def test_skimming_a_large_photo_leaves_fruit_as_they_are(
    encoder: EmbeddedEncoder, apples_in_a_corner: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = encoder.encode_fruit(apples_in_a_corner, (1.4,))
    monkeypatch.setattr(embedded, "SKIMMED", 1)
    skimmed = encoder.encode_fruit(apples_in_a_corner, (1.4,))
    fruit = 2.0 * (whole.features @ encoder.kinds().T).square().sum(-1) >= 0.15
    assert fruit.sum() > 100
    for name in ("features", "offsets", "embedding"):
        torch.testing.assert_close(getattr(skimmed, name)[fruit], getattr(whole, name)[fruit], atol=1e-4, rtol=0.0)
    assert not torch.allclose(skimmed.embedding[:30], whole.embedding[:30], atol=1e-3)


@pytest.mark.parametrize("more", [0, 1])
def test_only_images_of_more_pixels_than_the_limit_are_skimmed(
    encoder: EmbeddedEncoder, photo: np.ndarray, more: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scales = []
    monkeypatch.setattr(embedded, "see", lambda network, pixels, scale, *_: scales.append(scale) or see(
        network, pixels, scale, *_
    ))  # fmt: skip
    height, width = photo.shape[:2]
    monkeypatch.setattr(embedded, "SKIMMED", 4 * height * width - more)
    encoder.encode_dense(photo, (2.0, 1.0))
    assert scales == ([1.0, 2.0, 1.0] if more else [2.0, 1.0])


def test_a_large_photo_without_anything_that_may_be_fruit_has_the_outputs_of_half_its_size(
    encoder: EmbeddedEncoder, monkeypatch: pytest.MonkeyPatch
) -> None:
    grey = np.full((90, 130, 3), 128, np.uint8)
    monkeypatch.setattr(embedded, "SKIMMED", 1)
    view = encoder.encode_fruit(grey, (2.0,))
    half = see(encoder.network, torch.full((3, 90, 130), 128 / 255.0), 1.0).details
    channels = encoder.network.head.in_channels
    expected = resize(half, 90, 130).permute(1, 2, 0)
    torch.testing.assert_close(view.embedding[..., :channels], expected, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("size", [(1, 1), (5, 3), (3, 5), (20, 60), (60, 20), (1, 40)])
@pytest.mark.parametrize("scales", [(), (0.01,), (0.4,), (2.0,), (1.3, 0.65)])
def test_photos_of_any_size_are_seen_at_any_scale(
    encoder: EmbeddedEncoder, size: tuple[int, int], scales: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    image = np.random.default_rng(5).integers(0, 256, (*size, 3), dtype=np.uint8)
    for limit in (embedded.SKIMMED, 1):
        monkeypatch.setattr(embedded, "SKIMMED", limit)
        view = encoder.encode_fruit(image, scales)
        expected = map_size(*size, scales or scales_of(*size))
        assert view.features.shape[:2] == view.offsets.shape[:2] == view.embedding.shape[:2] == expected
        assert torch.allclose(view.features.norm(dim=-1), torch.ones(expected), atol=1e-4)
        assert bool(view.offsets.isfinite().all())
