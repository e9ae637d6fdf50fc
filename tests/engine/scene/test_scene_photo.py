"""Photos on disk: sizes, modes, masks, EXIF, damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import PosedPhoto, read_posed_photos
from fruitlangs.engine.scene.photos.resample import shrink

PINHOLE = Lens("PINHOLE", (30.0, 30.0, 16.0, 12.0), 32, 24)
PIXELS = np.random.default_rng(0).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def pose(path: Path, lens: Lens = PINHOLE, mask: Path | None = None, downscale: float = 1.0) -> PosedPhoto:
    (posed,) = read_posed_photos(
        path, name=path.name, lens=lens, world_to_camera=np.eye(4), mask_path=mask, downscale=downscale
    )
    return posed


def save(path: Path, pixels: np.ndarray, **options: object) -> Path:
    Image.fromarray(pixels).save(path, **options)
    return path


def test_a_pinhole_photo_passes_through(tmp_path: Path) -> None:
    posed = pose(save(tmp_path / "a.png", PIXELS))
    assert (posed.photo.pixels() == PIXELS).all()
    assert posed.photo.mask() is None


def test_half_size_is_the_average_of_four_pixels(tmp_path: Path) -> None:
    posed = pose(save(tmp_path / "a.png", PIXELS), downscale=2)
    average = PIXELS.reshape(12, 2, 16, 2, 3).mean(axis=(1, 3))
    np.testing.assert_array_equal(posed.photo.pixels(), np.rint(average.astype(np.float32)))
    np.testing.assert_allclose(posed.camera.K, [[15, 0, 8], [0, 15, 6], [0, 0, 1]])
    assert (posed.camera.width, posed.camera.height) == (16, 12)


@pytest.mark.parametrize(
    ("downscale", "max_side", "width"), [(1, 16, 16), (2, 0, 16), (1, 0, 32), (2, 20, 16), (1, 40, 32)]
)
def test_a_photo_larger_than_the_limit_is_read_smaller(
    downscale: float, max_side: int, width: int, tmp_path: Path
) -> None:
    path = save(tmp_path / "a.png", PIXELS)
    (posed,) = read_posed_photos(
        path, name="a", lens=PINHOLE, world_to_camera=np.eye(4), downscale=downscale, max_side=max_side
    )
    assert (posed.camera.width, posed.photo.pixels().shape[1]) == (width, width)


def test_an_uneven_resize_averages_exact_areas() -> None:
    # 3 pixels into 2: each new one is one and a half old ones
    row = np.array([[[10.0], [20.0], [60.0]]], dtype=np.float32)
    np.testing.assert_allclose(shrink(row, 2, 1)[0, :, 0], [(10 + 10) / 1.5, (10 + 60) / 1.5], rtol=1e-6)


def test_a_photo_with_too_few_pixels_to_count_on_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"a\.png is read with 8x6 pixels, too few.*--scene\.downscale.*8 a side"):
        pose(save(tmp_path / "a.png", PIXELS), downscale=4)


def test_a_ramp_stays_in_place_under_an_uneven_downscale(tmp_path: Path) -> None:
    lens = Lens("PINHOLE", (100.0, 100.0, 60.0, 15.0), 120, 30)
    ramp = np.repeat(np.repeat(np.arange(120, dtype=np.uint8)[None, :, None] * 2, 30, axis=0), 3, axis=2)
    posed = pose(save(tmp_path / "ramp.png", ramp), lens, downscale=2.7)
    width = posed.camera.width
    centers = (np.arange(width) + 0.5) * 120 / width  # of the new pixels, in old ones
    assert np.abs(posed.photo.pixels()[1, :, 0] - (centers - 0.5) * 2).max() <= 1.0
    assert posed.camera.K[0, 2] == pytest.approx(60 * width / 120)


def test_a_photo_resized_after_calibration_gets_matching_intrinsics(tmp_path: Path) -> None:
    posed = pose(save(tmp_path / "a.png", PIXELS), Lens("PINHOLE", (120.0, 120.0, 64.5, 48.0), 128, 96))
    np.testing.assert_allclose(posed.camera.K, [[30, 0, 64.5 / 4], [0, 30, 12], [0, 0, 1]])
    assert posed.photo.pixels().shape == (24, 32, 3)


@pytest.mark.parametrize("size", [(127, 95), (129, 97), (126, 94)])
def test_rounding_of_a_resize_is_forgiven(tmp_path: Path, size: tuple[int, int]) -> None:
    pose(save(tmp_path / "a.png", PIXELS), Lens("PINHOLE", (120.0, 120.0, 64.0, 48.0), *size))


def test_a_photo_of_another_shape_is_named(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", PIXELS[:20])
    with pytest.raises(SceneError, match=r"a\.png has 32x20 pixels but its camera 32x24"):
        pose(path)


def test_exif_orientation_is_not_applied(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 3
    posed = pose(save(tmp_path / "a.png", PIXELS, exif=exif))
    assert (posed.photo.pixels() == PIXELS).all()
    assert posed.skyward.tolist() == [0, 1, 0]


@pytest.mark.parametrize(("orientation", "turns"), [(6, -1), (8, 1)])
def test_exif_orientation_is_applied_where_only_that_fits_the_camera(
    tmp_path: Path, orientation: int, turns: int
) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    posed = pose(save(tmp_path / "a.png", PIXELS, exif=exif), Lens("PINHOLE", (30.0, 30.0, 12.0, 16.0), 24, 32))
    assert (posed.photo.pixels() == np.rot90(PIXELS, turns)).all()
    assert posed.skyward.tolist() == [0, -1, 0]


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, -1), (8, 1)])
def test_the_top_of_a_turned_photo_is_where_exif_puts_it(tmp_path: Path, orientation: int, turns: int) -> None:
    x, y = np.meshgrid(np.arange(32) - 15.5, np.arange(24) - 11.5)
    exif = Image.Exif()
    exif[0x0112] = orientation
    skyward = pose(save(tmp_path / "a.png", PIXELS, exif=exif)).skyward
    upright_height = np.rot90(x * skyward[0] + y * skyward[1], turns)
    assert (upright_height[0] == upright_height.max()).all()


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "YCbCr", "RGBA", "LA"])
def test_every_mode_becomes_rgb(tmp_path: Path, mode: str) -> None:
    path = tmp_path / ("a.tif" if mode in ("CMYK", "YCbCr") else "a.png")
    Image.fromarray(PIXELS).convert(mode).save(path)
    expected = np.asarray(Image.fromarray(PIXELS).convert(mode).convert("RGB"))
    assert (pose(path).photo.pixels() == expected).all()


def test_sixteen_bit_grey_keeps_its_range(tmp_path: Path) -> None:
    grey = np.linspace(0, 65535, 24 * 32).round().astype(np.uint16).reshape(24, 32)
    pixels = pose(save(tmp_path / "a.png", grey)).photo.pixels()
    np.testing.assert_array_equal(pixels, np.repeat(np.rint(grey / 257.0)[..., None], 3, axis=2))


def test_alpha_is_a_mask(tmp_path: Path) -> None:
    alpha = np.full((24, 32, 1), 255, dtype=np.uint8)
    alpha[:5] = 0
    mask = pose(save(tmp_path / "a.png", np.concatenate([PIXELS, alpha], axis=2))).photo.mask()
    assert mask is not None
    assert not mask[:5].any()
    assert mask[5:].all()


@pytest.mark.parametrize(("mode", "white"), [("L", 255), ("L", 1), ("1", 255), ("RGB", 255), ("P", 255)])
def test_black_in_a_mask_file_is_not_used(tmp_path: Path, mode: str, white: int) -> None:
    stored = np.zeros((24, 32), dtype=np.uint8)
    stored[:, 8:] = white
    Image.fromarray(stored).convert(mode).save(tmp_path / "m.png")
    mask = pose(save(tmp_path / "a.png", PIXELS), mask=tmp_path / "m.png").photo.mask()
    assert mask is not None
    assert (mask == (stored > 0)).all()


def test_a_downscaled_pixel_that_is_masked_in_part_is_not_used(tmp_path: Path) -> None:
    stored = np.full((24, 32), 255, dtype=np.uint8)
    stored[0, 0] = 0
    mask = pose(save(tmp_path / "a.png", PIXELS), mask=save(tmp_path / "m.png", stored), downscale=2).photo.mask()
    assert mask is not None
    assert mask.shape == (12, 16)
    assert np.argwhere(~mask).tolist() == [[0, 0]]


def test_a_mask_is_undistorted_with_its_photo(tmp_path: Path) -> None:
    lens = Lens("SIMPLE_RADIAL", (30.0, 16.0, 12.0, 0.3), 32, 24)
    stored = np.full((24, 32), 255, dtype=np.uint8)
    stored[:, :16] = 0
    path = save(tmp_path / "a.png", PIXELS)
    lens_only = pose(path, lens).photo.mask()
    both = pose(path, lens, mask=save(tmp_path / "m.png", stored)).photo.mask()
    assert lens_only is not None
    assert both is not None
    assert not lens_only[0, 0]
    assert (both[:, 17:] == lens_only[:, 17:]).all()
    assert not both[:, :16].any()


def test_a_mask_of_another_shape_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"Mask .*m\.png has 32x12"):
        pose(save(tmp_path / "a.png", PIXELS), mask=save(tmp_path / "m.png", PIXELS[:12]))


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif"])
def test_a_truncated_photo_is_named_when_it_loads(tmp_path: Path, suffix: str) -> None:
    path = save(tmp_path / f"a.{suffix}", np.tile(PIXELS, (10, 10, 1)))
    posed = pose(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SceneError, match=rf"a\.{suffix}"):
        posed.photo.pixels()


@pytest.mark.parametrize("content", [b"", b"not a picture", b"\x89PNG\r\n\x1a\n" + bytes(40)])
def test_a_file_that_is_no_picture_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(SceneError, match=r"a\.png cannot be read as a picture"):
        pose(tmp_path / "a.png")


def test_reading_headers_decodes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "a.png", PIXELS)

    def fail(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr("PIL.ImageFile.ImageFile.load", fail)
    assert pose(path).camera.width == 32


def test_a_panorama_becomes_six_views_around_one_centre(tmp_path: Path) -> None:
    path = save(tmp_path / "pano.png", np.tile(PIXELS, (2, 3, 1)))
    lens = Lens("EQUIRECTANGULAR", (96.0, 48.0), 96, 48)
    views = read_posed_photos(path, name="pano.png", lens=lens, world_to_camera=np.eye(4))
    assert [view.photo.name for view in views] == [
        f"pano.png@{face}" for face in ("back", "down", "front", "left", "right", "up")
    ]
    directions = {view.photo.name.split("@")[1]: view.camera.forward.tolist() for view in views}
    assert directions["front"] == [0, 0, 1]
    assert directions["down"] == [0, 1, 0]
    assert directions["right"] == [1, 0, 0]
    for view in views:
        assert view.photo.pixels().shape == (view.camera.height, view.camera.width, 3)
        assert np.linalg.det(view.camera.world_to_camera[:3, :3]) == pytest.approx(1.0)
