"""The scale through the whole chain: measured once, kept by the result, changed without training again."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from fruitlangs.engine.config import Config, CountConfig, TrainConfig, UnitsConfig
from fruitlangs.engine.errors import SceneError, VocabularyError
from fruitlangs.engine.pipeline import Result, count_scene
from fruitlangs.engine.scene.formats.cameras_json import read_cameras

TINY = TrainConfig(steps=200, max_gaussians=8000)
COUNT = CountConfig(threshold=0.2, diameter=0.08, sample_budget=3000)
PAIR = ("001.jpg", "033.jpg")


def config(**units: object) -> Config:
    return Config(train=TINY, count=COUNT, units=UnitsConfig(**units))


def document(result: Result) -> dict:
    return json.loads((result.out / "fruits.json").read_text(encoding="utf-8"))


def rows(result: Result) -> list[dict[str, str]]:
    with (result.out / "fruits.csv").open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def counted(few_photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    """A count whose cameras are held to be twice as far from each other as they are in the scene."""
    out = tmp_path_factory.mktemp("counted")
    plain = count_scene(few_photos, ["fruit"], out, config=config())
    apart = dict(zip([photo.name for photo in plain.scene.images], plain.scene.cameras, strict=True))
    length = 2.0 * float(np.linalg.norm(apart[PAIR[0]].center - apart[PAIR[1]].center))
    return count_scene(few_photos, ["fruit"], out, config=config(length=length, cameras=PAIR))


def test_a_scale_needs_no_new_training(counted: Result) -> None:
    assert counted.reused == ["train", "embed"]


def test_a_known_length_makes_metres_of_fruits_json_and_millimetres_of_the_table(counted: Result) -> None:
    content = document(counted)
    assert (content["unit"], content["metres_per_unit"]) == ("m", pytest.approx(2.0))
    assert content["count"] > 0
    for fruit, entry, row in zip(counted.fruit_count.fruits, content["fruits"], rows(counted), strict=True):
        assert entry["diameter"] == pytest.approx(2.0 * fruit.diameter, abs=1e-6)
        assert float(row["diameter_mm"]) == pytest.approx(2000.0 * fruit.diameter, abs=0.01)
        np.testing.assert_allclose(entry["center"], fruit.center, atol=1e-6)


def test_the_provenance_says_how_the_scale_was_found(counted: Result) -> None:
    scale = document(counted)["provenance"]["scale"]
    assert (scale["measure"], scale["standard_error"]) == ("cameras", None)
    assert all(name in scale["of"] for name in PAIR)


def test_the_provenance_names_the_template_that_was_counted_with(counted: Result, tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    trimesh.creation.icosphere().export(path)
    method = CountConfig(method="template", template=str(path))
    again = count_scene(counted.out, ["fruit"], tmp_path / "again", config=Config(count=method))
    assert document(again)["provenance"]["template_sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert "template_sha256" not in document(counted)["provenance"]


def test_another_prompt_of_the_result_keeps_its_scale(counted: Result, tmp_path: Path) -> None:
    again = count_scene(counted.out, ["leaf"], tmp_path, config=Config(count=COUNT))
    assert read_cameras(tmp_path / "cameras.json").metres_per_unit == pytest.approx(2.0)
    for part in ("config", "metres_per_unit"):
        assert document(again)[part] == document(counted)[part]
    assert document(again)["provenance"]["scale"] == document(counted)["provenance"]["scale"]


def test_a_result_without_its_photos_can_be_given_another_scale(counted: Result, tmp_path: Path) -> None:
    moved = shutil.copytree(counted.out, tmp_path / "moved", ignore=shutil.ignore_patterns("cache"))
    content = document(counted)
    content["provenance"]["source"] = str(tmp_path / "gone")
    (moved / "fruits.json").write_text(json.dumps(content))
    length = content["config"]["units"]["length"] / 4.0
    again = count_scene(moved, ["fruit"], moved, config=config(length=length, cameras=PAIR))
    assert document(again)["metres_per_unit"] == pytest.approx(0.5)
    outright = count_scene(moved, ["fruit"], moved, config=config(metres_per_unit=3.0))
    assert document(outright)["metres_per_unit"] == 3.0
    assert document(outright)["provenance"]["scale"]["measure"] == "metres_per_unit"
    taken = count_scene(moved, ["fruit"], moved, config=config(gps=False))
    assert document(taken)["unit"] == "scene units"
    assert "scale" not in document(taken)["provenance"]
    assert "diameter_units" in rows(taken)[0]


def test_a_scene_three_times_as_large_in_its_units_is_as_large_in_metres(few_photos: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(few_photos, tmp_path / "scene")
    frames = json.loads((scene / "transforms.json").read_text())
    for frame in frames["frames"]:
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] *= 3.0
        frame["transform_matrix"] = pose.tolist()
    points = trimesh.load(scene / "points.ply")
    trimesh.PointCloud(3.0 * points.vertices, points.colors).export(scene / "points.ply")
    (scene / "transforms.json").write_text(json.dumps(frames))
    usual = config(length=2.5, cameras=PAIR)
    wide = dataclasses.replace(usual, count=dataclasses.replace(COUNT, diameter=3.0 * 0.08))
    small = count_scene(few_photos, ["fruit"], tmp_path / "small", config=usual)
    large = count_scene(scene, ["fruit"], tmp_path / "large", config=wide)
    assert large.scene.spread == pytest.approx(3.0 * small.scene.spread)
    metres = [result.scene.spread * result.scene.metres_per_unit for result in (small, large)]
    assert metres[1] == pytest.approx(metres[0])


def test_the_gps_tags_of_the_photos_give_the_scale_with_its_error(few_photos: Path, tmp_path: Path) -> None:
    scene = shutil.copytree(few_photos, tmp_path / "scene")
    frames = json.loads((scene / "transforms.json").read_text())["frames"]
    for frame in frames:
        east, north, up = 5.0 * np.array(frame["transform_matrix"])[:3, 3]
        exif = Image.Exif()
        exif[ExifTags.IFD.GPSInfo] = {
            ExifTags.GPS.GPSLatitude: (IFDRational(round((47.0 + north / 111_175.0) * 10**9), 10**9), 0, 0),
            ExifTags.GPS.GPSLongitude: (IFDRational(round((8.0 + east / 76_056.0) * 10**9), 10**9), 0, 0),
            ExifTags.GPS.GPSAltitude: IFDRational(round((400.0 + up) * 1000), 1000),
        }
        with Image.open(scene / frame["file_path"]) as photo:
            photo.save(scene / frame["file_path"], exif=exif)
    result = count_scene(scene, ["fruit"], tmp_path / "out", config=config())
    scale = document(result)["provenance"]["scale"]
    assert scale["measure"] == "gps"
    assert scale["metres_per_unit"] == pytest.approx(5.0, rel=0.002)
    assert 0.0 < scale["standard_error"] < 0.05
    assert not any("GPS" in notice or "tag" in notice for notice in result.notices)


def test_an_unknown_photo_costs_no_training(few_photos: Path, tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"no photo '34\.jpg'. The nearest name is"):
        count_scene(few_photos, ["fruit"], tmp_path, config=config(length=1.0, cameras=("001.jpg", "34.jpg")))
    assert not list(tmp_path.rglob("train-*"))


def test_an_unknown_object_costs_no_training(few_photos: Path, tmp_path: Path) -> None:
    with pytest.raises(VocabularyError, match="nearest known: bucket"):
        count_scene(few_photos, ["fruit"], tmp_path, config=config(length=0.3, object="bukket"))
    assert not list(tmp_path.rglob("train-*"))


def test_an_object_that_is_not_in_the_scene_is_an_error_that_says_how_near_it_came(
    counted: Result, tmp_path: Path
) -> None:
    with pytest.raises(SceneError, match=r"the scene has no ladder to measure: \d .*highest probability is 0\.\d\d"):
        count_scene(counted.out, ["fruit"], tmp_path, config=config(length=2.0, object="ladder"))
    assert not (tmp_path / "fruits.json").exists()


def test_an_object_that_is_in_the_scene_gives_its_scale(counted: Result, tmp_path: Path) -> None:
    short, long = (
        count_scene(counted.out, ["fruit"], tmp_path, config=config(length=length, object="leaf"))
        for length in (1.0, 4.0)
    )
    assert long.scene.metres_per_unit == pytest.approx(4.0 * short.scene.metres_per_unit)
    assert "the longest side of the largest leaf" in document(long)["provenance"]["scale"]["of"]
