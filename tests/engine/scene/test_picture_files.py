"""HEIC photos are read like others, RAW files are refused with advice, and EXIF gives the focal length."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pillow_heif
import pytest
from PIL import ExifTags, Image

from fruitlangs.engine.config import PhotosConfig
from fruitlangs.engine.errors import SceneError
from fruitlangs.engine.scene.photos import picture_file
from fruitlangs.engine.scene.photos.focal import exif_focal
from fruitlangs.engine.scene.photos.photo import read_header
from fruitlangs.engine.scene.photos.picture_file import RAW_SUFFIXES, open_picture
from fruitlangs.engine.scene.pycolmap_import import colmap_library
from fruitlangs.engine.scene.sfm.find_cameras import list_photos
from fruitlangs.engine.scene.source import Source

WIDTH, HEIGHT = 96, 64


def write(path: Path, tags: dict[int, Any] | None = None, orientation: int = 1) -> Path:
    """A picture that is red at the top left, with EXIF tags."""
    pixels = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    pixels[: HEIGHT // 2, : WIDTH // 2] = 220, 30, 30
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    exif.get_ifd(ExifTags.IFD.Exif).update(tags or {})
    if path.suffix == ".jpg":
        Image.fromarray(pixels).save(path, exif=exif, quality=95)
    else:
        pillow_heif.from_pillow(Image.fromarray(pixels)).save(path, exif=exif.tobytes(), quality=95)
    return path


@pytest.mark.parametrize("suffix", [".heic", ".HEIF"])
def test_a_heic_photo_is_listed_and_read(suffix: str, tmp_path: Path) -> None:
    photo = write(tmp_path / f"a{suffix}")
    assert list_photos(tmp_path) == [photo]
    header = read_header(photo)
    assert (header.width, header.height, header.has_alpha) == (WIDTH, HEIGHT, False)
    with open_picture(photo) as image:
        pixels = np.asarray(image)
    assert pixels[5, 5].tolist() == pytest.approx([220, 30, 30], abs=12)
    assert pixels[-5, -5].tolist() == pytest.approx([60, 60, 60], abs=12)


def test_the_rotation_of_a_heic_photo_is_not_applied_twice(tmp_path: Path) -> None:
    assert read_header(write(tmp_path / "a.heic", orientation=6)).orientation == 1
    assert read_header(write(tmp_path / "a.jpg", orientation=6)).orientation == 6


def test_a_truncated_heic_photo_is_an_error_that_names_it(tmp_path: Path) -> None:
    photo = write(tmp_path / "a.heic")
    photo.write_bytes(photo.read_bytes()[:300])
    with pytest.raises(SceneError, match=r"a\.heic cannot be read as a picture"):
        read_header(photo)


def test_without_its_package_a_heic_photo_is_an_error_that_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = write(tmp_path / "a.heic")
    picture_file._read_heif.cache_clear()
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(SceneError, match=r"HEIC photos need the package pillow-heif .*pip install pillow-heif"):
        read_header(photo)


@pytest.mark.parametrize("suffix", sorted(RAW_SUFFIXES))
def test_a_folder_of_raw_files_is_refused_with_advice(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"IMG_1{suffix.upper()}").write_bytes(b"raw")
    with pytest.raises(SceneError, match=rf"IMG_1\{suffix.upper()} is a RAW file.* Convert the photos to JPEG with"):
        Source(path=tmp_path).is_alone()


def test_a_raw_file_in_a_model_is_refused_too(tmp_path: Path) -> None:
    (tmp_path / "a.dng").write_bytes(b"raw")
    with pytest.raises(SceneError, match="is a RAW file"):
        read_header(tmp_path / "a.dng")


def test_a_raw_file_without_its_jpeg_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "IMG_1.jpg")
    for name in ("IMG_1.dng", "IMG_2.dng"):
        (tmp_path / name).write_bytes(b"raw")
    with pytest.raises(SceneError, match=r"IMG_2\.dng is a RAW file"):
        Source(path=tmp_path).find_poses(tmp_path / "cache", PhotosConfig())


FILM, FOCAL = ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.FocalLength
RESOLUTION, UNIT = ExifTags.Base.FocalPlaneXResolution, ExifTags.Base.FocalPlaneResolutionUnit
ACROSS, DOWN = ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight


def test_the_focal_length_by_film_is_that_of_colmap(tmp_path: Path) -> None:
    photo = write(tmp_path / "a.jpg", {FILM: 26})
    camera = colmap_library().infer_camera_from_image(str(photo))
    assert camera.has_prior_focal_length
    assert exif_focal(photo) == pytest.approx(camera.focal_length / WIDTH, rel=1e-3)


def test_a_heic_photo_has_the_focal_length_of_its_exif(tmp_path: Path) -> None:
    assert exif_focal(write(tmp_path / "a.heic", {FILM: 26})) == exif_focal(write(tmp_path / "a.jpg", {FILM: 26}))


@pytest.mark.parametrize(("resolution", "unit"), [(2540.0, 2), (1000.0, 3), (100.0, 4)])
def test_the_focal_length_by_the_sensor_needs_its_resolution(resolution: float, unit: int, tmp_path: Path) -> None:
    tags = {FOCAL: 24.0, RESOLUTION: resolution, UNIT: unit, ACROSS: 3600, DOWN: 2400}  # 36 mm wide
    assert exif_focal(write(tmp_path / "a.jpg", tags)) == pytest.approx(24 / 36)
    assert exif_focal(write(tmp_path / "b.jpg", {FOCAL: 24.0})) is None


@pytest.mark.parametrize("tags", [{}, {FILM: 0}, {FOCAL: 24.0, RESOLUTION: 0.0, ACROSS: 3600}])
def test_a_photo_without_a_focal_length_gives_none(tags: dict[int, Any], tmp_path: Path) -> None:
    assert exif_focal(write(tmp_path / "a.jpg", tags)) is None


def test_a_file_that_is_not_a_picture_has_no_focal_length(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"text")
    assert exif_focal(tmp_path / "a.jpg") is None
