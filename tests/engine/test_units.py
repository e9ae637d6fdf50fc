"""From a known length to millimetres: settings, cameras, points, objects, and what people read."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from fruitlangs.engine.config import Config, UnitsConfig
from fruitlangs.engine.errors import ConfigError, SceneError
from fruitlangs.engine.report.words import format_three_digits, length_unit, scale_text
from fruitlangs.engine.scene.camera import Camera, look_along
from fruitlangs.engine.scene.formats.cameras_json import add_scene_facts, camera_names, read_cameras
from fruitlangs.engine.scene.scale import scale_by_length
from fruitlangs.engine.splatting.gaussians import Gaussians, make_round_gaussians
from fruitlangs.engine.splatting.subject.extent import longest_side
from fruitlangs.engine.storage.files import write_text

UP = np.array([0.0, 0.0, 1.0])


def cameras(times: float = 1.0) -> list[Camera]:
    """Three cameras along x, 1 and 3 units from the first."""
    places = [np.array([x, 0.0, 0.0]) * times for x in (0.0, 1.0, 3.0)]
    return [Camera(np.eye(3), look_along(place, np.array([0.0, 1.0, 0.0]), UP), 8, 8) for place in places]


NAMES = ["a.jpg", "row/b.jpg", "pano.jpg@front"]


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"length": -1.0}, "--units.length is -1.0. Use a finite number above 0"),
        ({"length": 0.0}, "--units.length is 0.0. Use a finite number above 0"),
        ({"length": float("nan")}, "--units.length is nan"),
        ({"metres_per_unit": -2.0}, "--units.metres-per-unit is -2.0"),
        ({"length": 2.5}, "is 2.5 m, but what it measures is missing"),
        ({"object": "bucket"}, "--units.object has no length"),
        (
            {"length": 1.0, "object": "bucket", "cameras": ("a", "b")},
            "cameras and --units.object are both given",
        ),
        ({"length": 1.0, "metres_per_unit": 1.0}, "metres-per-unit and a known length are both given"),
        ({"object": "bucket", "metres_per_unit": 1.0}, "metres-per-unit and a known length are both given"),
        ({"length": 1.0, "cameras": ("a.jpg", "a.jpg")}, "a.jpg, a.jpg. Give the names of two photos"),
        ({"length": 1.0, "cameras": ("a.jpg",)}, "a.jpg. Give the names of two photos"),
        ({"length": 1.0, "points": (1.0, 2.0, 3.0, 1.0, 2.0, 3.0)}, "names the point .* twice"),
        ({"length": 1.0, "points": (1.0, 2.0, 3.0, 1.0, 2.0, float("inf"))}, "Use six finite numbers"),
        ({"length": 1.0, "object": " "}, "--units.object is empty"),
    ],
)
def test_units_that_make_no_sense_say_which_flag_and_what_to_do(settings: dict, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        UnitsConfig(**settings)


@pytest.mark.parametrize(
    "units",
    [
        UnitsConfig(),
        UnitsConfig(gps=False),
        UnitsConfig(length=2.5, cameras=("a.jpg", "b.jpg")),
        UnitsConfig(length=2.5, points=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0)),
    ],
)
def test_units_survive_the_document_of_their_result(units: UnitsConfig) -> None:
    config = Config(units=units)
    assert Config.from_document(json.loads(json.dumps(dataclasses.asdict(config)))) == config


def test_a_result_of_before_there_were_units_is_read_with_none() -> None:
    document = dataclasses.asdict(Config())
    del document["units"]
    assert Config.from_document(document).units == UnitsConfig()


def test_the_distance_of_two_cameras_gives_the_scale_whichever_comes_first() -> None:
    for pair in (("a.jpg", "row/b.jpg"), ("row/b.jpg", "a.jpg")):
        scale = scale_by_length(UnitsConfig(length=0.5, cameras=pair), NAMES, cameras())
        assert scale is not None
        assert scale.metres_per_unit == pytest.approx(0.5)
        assert "0.5 m" in scale.of


def test_a_panorama_is_named_without_its_faces() -> None:
    scale = scale_by_length(UnitsConfig(length=6.0, cameras=("a.jpg", "pano.jpg")), NAMES, cameras())
    assert scale is not None
    assert scale.metres_per_unit == pytest.approx(2.0)


def test_the_distance_of_two_points_gives_the_scale() -> None:
    scale = scale_by_length(UnitsConfig(length=1.0, points=(1.0, 1.0, 1.0, 4.0, 5.0, 1.0)), NAMES, cameras())
    assert scale is not None
    assert scale.metres_per_unit == pytest.approx(0.2)


def test_a_scene_three_times_as_large_in_its_units_is_as_large_in_metres() -> None:
    asked = UnitsConfig(length=0.7, cameras=("a.jpg", "pano.jpg"))
    small, large = (scale_by_length(asked, NAMES, cameras(times)) for times in (1.0, 3.0))
    assert small is not None
    assert large is not None
    assert 3.0 * large.metres_per_unit == pytest.approx(small.metres_per_unit)


def test_a_scale_given_outright_is_taken_as_it_is() -> None:
    scale = scale_by_length(UnitsConfig(metres_per_unit=0.25), NAMES, cameras())
    assert scale is not None
    assert (scale.metres_per_unit, scale.standard_error) == (0.25, None)


def test_without_a_length_or_with_that_of_an_object_cameras_and_points_give_no_scale() -> None:
    assert scale_by_length(UnitsConfig(), NAMES, cameras()) is None
    assert scale_by_length(UnitsConfig(length=0.3, object="bucket"), NAMES, cameras()) is None


def test_an_unknown_photo_is_an_error_that_names_the_nearest() -> None:
    with pytest.raises(SceneError, match=r"no photo 'row/c\.jpg'. The nearest name is row/b\.jpg"):
        scale_by_length(UnitsConfig(length=1.0, cameras=("a.jpg", "row/c.jpg")), NAMES, cameras())


def test_cameras_in_one_place_are_an_error() -> None:
    views = cameras()
    with pytest.raises(SceneError, match="taken from one place"):
        scale_by_length(UnitsConfig(length=1.0, cameras=("a.jpg", "b.jpg")), ["a.jpg", "b.jpg", "c.jpg"],
                        [views[0], views[0], views[2]])  # fmt: skip


def bar(length: float, at: float = 0.0, times: float = 1.0, spacing: float = 0.02) -> Gaussians:
    """Opaque Gaussians of 5 mm along a slanted bar of a square section, 6 cm wide."""
    along = np.arange(0.0, length + 1e-9, spacing)
    across = np.array([-0.03, 0.0, 0.03])
    grid = np.stack(np.meshgrid(along, across, across, indexing="ij"), -1).reshape(-1, 3)
    slant = np.linalg.qr(np.array([[1.0, 2.0, 0.5], [0.3, 1.0, 2.0], [2.0, 0.1, 1.0]]))[0]
    places = (grid @ slant.T + [at, 0.0, 0.0]) * times
    return make_round_gaussians(places, np.full(len(grid), 0.005 * times), np.full((len(grid), 3), 0.5), opacity=0.99)


def together(*parts: Gaussians) -> Gaussians:
    fields = ("means", "log_scales", "quats", "opacity_logits", "sh")
    return Gaussians(**{name: torch.cat([getattr(part, name) for part in parts]) for name in fields})


def side(gaussians: Gaussians) -> float | None:
    return longest_side(gaussians, np.ones(len(gaussians), np.float32))


@pytest.mark.parametrize("times", [1e-4, 1.0, 3.0, 1e4])
def test_the_longest_side_of_a_slanted_bar_is_its_length_at_any_scale(times: float) -> None:
    assert side(bar(1.0, times=times)) == pytest.approx(times * (1.0 + 2 * 0.005 * 1.17), rel=2e-3)


def test_the_largest_of_several_objects_is_measured() -> None:
    assert side(together(bar(0.4), bar(1.0, at=8.0), bar(0.6, at=-8.0))) == pytest.approx(side(bar(1.0)), rel=1e-6)


def test_an_object_that_a_leaf_hides_in_the_middle_is_measured_whole() -> None:
    whole = bar(1.0)
    hidden = torch.arange(len(whole)) // 9
    assert side(whole.select((hidden < 24) | (hidden > 27))) == pytest.approx(side(whole), rel=1e-6)


def test_haze_adds_nothing_to_an_object() -> None:
    haze = dataclasses.replace(bar(2.0), opacity_logits=torch.full((len(bar(2.0)),), -0.5))
    assert side(together(bar(1.0), haze)) == pytest.approx(side(bar(1.0)), rel=1e-6)


def test_a_few_gaussians_are_no_object() -> None:
    assert side(bar(1.0).select(torch.arange(9))) is None
    assert side(bar(1.0, spacing=0.9).select(torch.tensor([0, 9]))) is None


def test_a_cameras_file_with_another_scale_and_up_differs_in_nothing_else(tmp_path: Path) -> None:
    from fruitlangs.engine.scene.camera import ArrayPhoto, Scene
    from fruitlangs.engine.scene.formats.cameras_json import dump_cameras

    photos = [ArrayPhoto(name, np.zeros((8, 8, 3), np.uint8)) for name in NAMES]
    scene = Scene(cameras(), photos, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), UP)
    path = tmp_path / "cameras.json"
    write_text(path, dump_cameras(scene))
    assert add_scene_facts(path, scene) == path.read_text()
    other = dataclasses.replace(scene, metres_per_unit=0.1 + 0.2, up=np.array([0.0, 0.0, 1.0]))
    write_text(path, add_scene_facts(path, other))
    assert path.read_text() == dump_cameras(other)
    assert read_cameras(path).metres_per_unit == 0.1 + 0.2
    assert camera_names(path) == NAMES


def test_people_read_millimetres_where_the_scale_is_known_and_scene_units_where_not() -> None:
    unit, scale = length_unit(0.5)
    assert f"{format_three_digits(0.15645 * scale)} {unit}" == "78.2 mm"
    assert length_unit(None) == ("scene units", 1.0)
    assert [format_three_digits(value) for value in (1234.5, 0.078349, 112.2)] == ["1230", "0.0783", "112"]


def test_the_scale_is_reported_with_its_error_where_there_is_one() -> None:
    scale = {"metres_per_unit": 0.998, "measure": "gps", "of": "the GPS tags of 60 photos", "standard_error": 0.004}
    assert scale_text(scale) == "1 scene unit is 0.998 m ± 0.4 %, by the GPS tags of 60 photos"
    assert scale_text({**scale, "standard_error": None}) == "1 scene unit is 0.998 m, by the GPS tags of 60 photos"
