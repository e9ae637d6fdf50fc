"""The scale by GPS tags: what is read of them, where they are, and when they are not believed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.scene.gps import GpsScale, GpsTag, degrees_of, local_metres, read_gps, scale_by_gps
from fruitlangs.engine.scene.photos.lens import Lens
from fruitlangs.engine.scene.photos.photo import read_posed_photos

TAG, GPS = ExifTags.GPS, ExifTags.IFD.GPSInfo
RADIUS = 6_371_000.0
LENS = Lens("PINHOLE", (30.0, 30.0, 16.0, 12.0), 32, 24)


def sexagesimal(angle: float) -> tuple[IFDRational, ...]:
    minutes = abs(angle) % 1 * 60
    seconds = IFDRational(round(minutes % 1 * 60 * 1_000_000), 1_000_000)
    return IFDRational(int(abs(angle)), 1), IFDRational(int(minutes), 1), seconds


def entries(tag: GpsTag) -> dict[int, object]:
    """The EXIF entries of a place."""
    found: dict[int, object] = {
        TAG.GPSLatitudeRef: "S" if tag.latitude < 0 else "N",
        TAG.GPSLatitude: sexagesimal(tag.latitude),
        TAG.GPSLongitudeRef: "W" if tag.longitude < 0 else "E",
        TAG.GPSLongitude: sexagesimal(tag.longitude),
    }
    if tag.altitude is not None:
        found[TAG.GPSAltitudeRef] = b"\x01" if tag.altitude < 0 else b"\x00"
        found[TAG.GPSAltitude] = IFDRational(round(abs(tag.altitude) * 1000), 1000)
    return found


def write(path: Path, gps: dict[int, object] | None) -> Path:
    exif = Image.Exif()
    if gps is not None:
        exif[GPS] = gps
    Image.new("RGB", (32, 24)).save(path, exif=exif)
    return path


def tag_at(east: float, north: float, up: float | None, *, latitude: float = 48.1, longitude: float = 11.6) -> GpsTag:
    """A place so many metres from another, on a sphere: within a per cent of WGS84's."""
    return GpsTag(
        latitude + np.degrees(north / RADIUS),
        longitude + np.degrees(east / (RADIUS * np.cos(np.radians(latitude)))),
        None if up is None else 500.0 + up,
    )


def ring(count: int = 40) -> np.ndarray:
    """(count, 3) metres on a ring of 3 m, at two heights."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([3.0 * np.cos(angle), 3.0 * np.sin(angle), np.arange(count) % 2])


def measured(folder: Path, centers: np.ndarray, tags: list[GpsTag | None]) -> GpsScale:
    """The scale of photos with these tags, whose cameras have these centres."""
    views = []
    for index, (center, tag) in enumerate(zip(centers, tags, strict=True)):
        pose = np.eye(4)
        pose[:3, 3] = -center
        path = write(folder / f"{index:03d}.jpg", None if tag is None else entries(tag))
        views += read_posed_photos(path, name=path.name, lens=LENS, world_to_camera=pose)
    return scale_by_gps([view.camera for view in views], [view.photo for view in views])


@pytest.mark.parametrize(
    "tag",
    [GpsTag(48.137154, 11.576124, 519.25), GpsTag(-33.856784, 151.215297, -3.5), GpsTag(4.710989, -74.072092, None)],
)
def test_a_tag_is_read_as_it_was_written(tag: GpsTag, tmp_path: Path) -> None:
    read = read_gps(write(tmp_path / "a.jpg", entries(tag)))
    assert read is not None
    assert read.latitude == pytest.approx(tag.latitude, abs=1e-9)
    assert read.longitude == pytest.approx(tag.longitude, abs=1e-9)
    assert read.altitude == tag.altitude


def test_a_photo_without_tags_or_without_a_fix_gives_no_place(tmp_path: Path) -> None:
    place = entries(GpsTag(48.0, 11.0, 500.0))
    for gps in (None, {TAG.GPSLatitude: place[TAG.GPSLatitude]}, {**place, TAG.GPSStatus: "V"}):
        assert read_gps(write(tmp_path / "a.jpg", gps)) is None
    assert read_gps(write(tmp_path / "a.jpg", entries(GpsTag(0.0, 0.0, 0.0)))) is None
    Image.new("RGB", (32, 24)).save(tmp_path / "a.png")
    assert read_gps(tmp_path / "a.png") is None


@pytest.mark.parametrize(
    "wrong",
    [
        {TAG.GPSLatitude: sexagesimal(97.0)},
        {TAG.GPSLatitude: (IFDRational(48, 1), IFDRational(1, 0), IFDRational(0, 1))},
        {TAG.GPSLatitude: (IFDRational(48, 1),)},
        {TAG.GPSLongitudeRef: "Q"},
        {TAG.GPSAltitude: IFDRational(0, 0)},
    ],
)
def test_tags_that_make_no_sense_are_an_error_that_names_the_photo(wrong: dict, tmp_path: Path) -> None:
    path = write(tmp_path / "a.jpg", {**entries(GpsTag(48.0, 11.0, 500.0)), **wrong})
    with pytest.raises(FormatError, match=r"GPS tags of .*a\.jpg make no sense"):
        read_gps(path)


def test_local_metres_are_those_of_the_ellipsoid() -> None:
    # a degree along the meridian from 47.5 to 48.5 is 111,200 m, along the parallel of 48 it is 74,628 m
    south, north, east = GpsTag(47.5, 11.0, 0.0), GpsTag(48.5, 11.0, 0.0), GpsTag(47.5, 11.0, 100.0)
    places = local_metres([south, north])
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(111_200, rel=1e-4)
    np.testing.assert_allclose(local_metres([south, east])[1] - local_metres([south, east])[0], [0, 0, 100], atol=1e-6)
    places = local_metres([GpsTag(48.0, 11.0, 0.0), GpsTag(48.0, 12.0, 0.0)])
    assert places[1, 0] - places[0, 0] == pytest.approx(74_628, rel=1e-4)
    across = local_metres([GpsTag(10.0, 179.9999, 0.0), GpsTag(10.0, -179.9999, 0.0)])
    assert across[1, 0] - across[0, 0] == pytest.approx(21.93, rel=1e-3)


@pytest.mark.parametrize("metres_per_unit", [0.4, 1.0, 7.0])
def test_tags_that_agree_with_the_cameras_give_the_scale(metres_per_unit: float, tmp_path: Path) -> None:
    turned = ring() @ np.linalg.qr(np.array([[1.0, 2.0, 0.5], [0.3, 1.0, 2.0], [2.0, 0.1, 1.0]]))[0]
    noise = np.random.default_rng(0).normal(0.0, 0.02, (40, 3))
    found = measured(tmp_path, turned / metres_per_unit, [tag_at(*place) for place in ring() + noise])
    assert found.notices == []
    assert found.scale is not None
    assert found.scale.metres_per_unit == pytest.approx(metres_per_unit, rel=0.01)
    assert found.scale.standard_error is not None
    assert 0.0 < found.scale.standard_error < 0.01 * metres_per_unit
    assert found.scale.of == "the GPS tags of 40 photos"


def test_a_few_tags_that_are_quite_wrong_do_not_change_the_scale(tmp_path: Path) -> None:
    places = ring()
    places[::8] += [30.0, -20.0, 5.0]
    found = measured(tmp_path, ring(), [tag_at(*place) for place in places])
    assert found.scale is not None
    assert found.scale.metres_per_unit == pytest.approx(1.0, rel=0.01)


def test_the_stated_error_holds_for_a_receiver_that_drifts() -> None:
    """Over many walks around a tree with errors that photos share, the scale is as far off as its error says."""
    from fruitlangs.engine.scene.alignment import align
    from fruitlangs.engine.scene.gps import _standard_error

    generator = np.random.default_rng(1)
    off, stated = [], []
    for _ in range(12):
        steps = generator.normal(0.0, 1.0, (41, 3)) * np.sqrt(1 - 0.9**2)
        drift = np.zeros((40, 3))
        drift[0] = generator.normal(0.0, 1.0, 3)
        for photo in range(1, 40):
            drift[photo] = 0.9 * drift[photo - 1] + steps[photo]
        places = ring() + 0.3 * drift
        fit = align(ring(), places)
        off.append(fit.scale - 1.0)
        stated.append(_standard_error(fit, ring(), places))
    assert 0.5 < np.sqrt(np.mean(np.square(off)) / np.mean(np.square(stated))) < 1.5


def test_gps_of_a_phone_around_a_small_tree_is_not_used(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).normal(0.0, 3.0, (40, 3))
    found = measured(tmp_path, ring(), [tag_at(*place) for place in ring() + noise])
    assert found.scale is None
    assert len(found.notices) == 1
    assert "the GPS tags of 40 photos tell no scale: its standard error would be" in found.notices[0]
    assert "--units.length" in found.notices[0]


@pytest.mark.parametrize(
    ("tags", "said"),
    [
        ([tag_at(*place) for place in ring(4)[:3]] + [None], "3 photos tell no scale: at least 4 are needed"),
        ([tag_at(1.0, 2.0, 3.0)] * 4, "4 photos tell no scale: all are of one place"),
    ],
)
def test_too_few_tags_or_all_of_one_place_are_a_notice(tags: list, said: str, tmp_path: Path) -> None:
    found = measured(tmp_path, ring(4), tags)
    assert found.scale is None
    assert len(found.notices) == 1
    assert said in found.notices[0]


def test_photos_without_any_tag_give_no_notice(tmp_path: Path) -> None:
    assert measured(tmp_path, ring(4), [None] * 4) == GpsScale(notices=[])


def test_a_capture_at_one_height_needs_no_altitudes(tmp_path: Path) -> None:
    flat = ring() * [1.0, 1.0, 0.0]
    found = measured(tmp_path, 0.5 * flat, [tag_at(east, north, None) for east, north, _ in flat])
    assert found.scale is not None
    assert found.scale.metres_per_unit == pytest.approx(2.0, rel=0.01)


def test_a_photo_without_altitude_is_left_out_where_others_have_one(tmp_path: Path) -> None:
    tags = [tag_at(east, north, None if index < 4 else up) for index, (east, north, up) in enumerate(ring())]
    found = measured(tmp_path, ring(), tags)
    assert found.scale is not None
    assert found.scale.of == "the GPS tags of 36 photos"


def test_a_photo_whose_tags_make_no_sense_is_reported_and_the_others_count(tmp_path: Path) -> None:
    tags = [tag_at(*place) for place in ring(12)]
    tags[5] = GpsTag(97.0, 11.0, 500.0)
    found = measured(tmp_path, ring(12), tags)
    assert found.scale is not None
    assert found.scale.of == "the GPS tags of 11 photos"
    assert len(found.notices) == 1
    assert "005.jpg make no sense" in found.notices[0]
    assert "photos left out of the scale: 1" in found.notices[0]


@pytest.mark.parametrize("straight", [True, False], ids=["a flight on one line", "a walk there and back"])
def test_points_of_a_row_are_placed_on_the_earth(straight: bool) -> None:
    """Scene units are half a metre, the scene's y points down, and its x to the north-east."""
    along = np.linspace(0.0, 60.0, 40)
    level = np.stack([along, np.zeros(40) if straight else 4.0 * (np.arange(40) % 2)], axis=1)
    turn = np.array([[0.6, 0.8], [-0.8, 0.6]])

    def earth(places: np.ndarray) -> np.ndarray:
        return 0.5 * places @ turn

    # Seen from above, x is to the right and z, with y down, is upwards on the map.
    centers = np.stack([level[:, 0], np.full(40, -3.0), level[:, 1]], axis=1)
    error = np.random.default_rng(1).normal(0.0, 0.02, (40, 2))
    tags = [tag_at(*place, None) for place in earth(level) + error]
    asked = np.array([[10.0, 0.0, 3.0], [50.0, 0.0, -2.0]])
    found = degrees_of(asked, centers, tags, np.array([0.0, -1.0, 0.0]))
    expected = [tag_at(*place, None) for place in earth(asked[:, [0, 2]])]
    assert found is not None
    metres = local_metres([*(GpsTag(*each, None) for each in found), *expected])
    assert np.abs(metres[:2] - metres[2:]).max() < 0.05


def test_tags_that_only_scatter_place_no_point() -> None:
    random = np.random.default_rng(1)
    tags = [tag_at(*place, None) for place in random.normal(0.0, 3.0, (40, 2))]
    up = np.array([0.0, 0.0, 1.0])
    assert degrees_of(np.zeros((1, 3)), random.normal(0.0, 2.0, (40, 3)), tags, up) is None
    assert degrees_of(np.zeros((1, 3)), np.zeros((40, 3)), tags, up) is None
