"""The whole chain on photos of five balls: no stage faked."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import ball_scene
import numpy as np
import pytest
from conftest import balls_config
from safetensors import safe_open
from safetensors.numpy import load_file
from safetensors.torch import save_file

from fruitlangs.engine.config import Config, CountConfig, SceneConfig, TrainConfig
from fruitlangs.engine.counting.fruit import Fruit
from fruitlangs.engine.errors import Cancelled, ConfigError, CountingError, EncoderError, OutputError, VocabularyError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.features.photo_features import load_photo_features, save_photo_features
from fruitlangs.engine.pipeline import Result, count_scene, note_clumped, reconstruct_scene
from fruitlangs.engine.reconstruction import PHOTOS
from fruitlangs.engine.storage.files import file_hash
from fruitlangs.engine.training import QUALITIES

SAMPLE = Path(__file__).resolve().parents[2] / "examples" / "orchard_tree"
CONTRACT = ["gaussians.ply", "features.safetensors", "fruits.json", "fruits.csv", "fruits.glb", "fruits.ply"]
CONTRACT += ["selection.safetensors", "still.jpg", "report.html"]


def document(out: Path) -> dict:
    return json.loads((out / "fruits.json").read_text(encoding="utf-8"))


def without_times(out: Path) -> dict:
    content = document(out)
    del content["provenance"]["date"], content["provenance"]["seconds"]
    return content


def test_a_run_writes_every_file_of_the_contract_and_nothing_half_made(counted_balls: Result) -> None:
    assert all((counted_balls.out / name).is_file() for name in CONTRACT)
    assert len(list((counted_balls.out / "pictures").glob("view_*.png"))) == 4
    assert not list(counted_balls.out.rglob("*.part*"))
    assert not list((counted_balls.out / "cache").glob("publish-*"))


def test_fruit_of_a_few_pixels_in_reduced_photos_are_reported_with_the_size_to_read(
    balls: Path, tmp_path: Path
) -> None:
    counted = count_scene(balls, ["apple"], tmp_path, config=replace(balls_config(), scene=SceneConfig(max_side=80)))
    assert "photos with up to 128 pixels a side were read at 80; --scene.max-side sets it" in counted.notices
    assert max(camera.width for camera in counted.scene.cameras) == 80
    assert 8.0 < document(counted.out)["pixel_width"] < 12.0
    (notice,) = [notice for notice in counted.notices if "pixels wide" in notice]
    assert "--scene.max-side 1" in notice
    assert notice in document(counted.out)["notices"]
    assert notice in (counted.out / "report.html").read_text(encoding="utf-8")


def test_a_0_with_cameras_that_the_photos_contradict_is_an_error_and_the_earlier_result_stays(
    counted_balls: Result, tmp_path: Path
) -> None:
    scene = shutil.copytree(SAMPLE, tmp_path / "scene")
    out = shutil.copytree(counted_balls.out, tmp_path / "out")
    photos = sorted((scene / "images").iterdir())
    pictures = [photo.read_bytes() for photo in photos]
    for photo, other in zip(photos, pictures[17:] + pictures[:17], strict=True):
        photo.write_bytes(other)
    config = Config(scene=SceneConfig(max_side=160), train=TrainConfig(steps=150, max_gaussians=10_000))
    with pytest.raises(CountingError, match=r"The 0 for fruit is not a count: held-out photos are reproduced poorly"):
        count_scene(scene, ["fruit"], out, config=config)
    assert document(out) == document(counted_balls.out)
    _, log = reconstruct_scene(scene, out, config=config)
    assert len([notice for notice in log.notices if "the cameras and the count may be wrong" in notice]) == 1
    assert not [notice for notice in counted_balls.notices if "the cameras and the count may be wrong" in notice]


def test_missing_photos_are_reported_once(tmp_path: Path) -> None:
    scene = shutil.copytree(SAMPLE, tmp_path / "scene")
    photos = sorted((scene / "images").iterdir())
    for photo in photos[5:8]:
        photo.unlink()
    config = Config(scene=SceneConfig(max_side=60), train=TrainConfig(steps=2, max_gaussians=500))
    made, log = reconstruct_scene(scene, tmp_path / "out", config=config)
    (notice,) = [notice for notice in log.notices if "are missing" in notice]
    assert notice.startswith(f"3 of the {len(photos)} photos that ")
    assert all(photo.name in notice for photo in photos[5:8])
    assert len(made.scene.cameras) == len(made.scene.images) == len(photos) - 3


def test_the_files_agree_on_the_count(counted_balls: Result) -> None:
    rows = (counted_balls.out / "fruits.csv").read_text().splitlines()[1:]
    assert document(counted_balls.out)["count"] == len(rows) == counted_balls.fruit_count.count > 0


def test_two_runs_differ_in_date_and_seconds_only(balls: Path, counted_balls: Result, tmp_path: Path) -> None:
    again = count_scene(balls, ["apple"], tmp_path, config=balls_config())
    assert without_times(again.out) == without_times(counted_balls.out)
    assert (again.out / "gaussians.ply").read_bytes() == (counted_balls.out / "gaussians.ply").read_bytes()


def test_a_second_prompt_reuses_training_and_features(balls: Path, counted_balls: Result, tmp_path: Path) -> None:
    shutil.copytree(counted_balls.out, tmp_path / "out")
    second = count_scene(balls, ["leaf"], tmp_path / "out", config=balls_config())
    assert second.reused == ["train", "embed"]
    assert document(second.out)["provenance"]["prompts"] == ["leaf"]
    assert (second.out / "gaussians.ply").read_bytes() == (counted_balls.out / "gaussians.ply").read_bytes()


def test_a_result_folder_answers_without_its_photos_as_with_them(counted_balls: Result, tmp_path: Path) -> None:
    shutil.copytree(counted_balls.out, tmp_path / "moved", ignore=shutil.ignore_patterns("cache"))
    content = document(tmp_path / "moved")
    content["provenance"]["source"] = str(tmp_path / "gone")
    (tmp_path / "moved" / "fruits.json").write_text(json.dumps(content))
    again = count_scene(tmp_path / "moved", ["apple"], tmp_path / "again", config=balls_config())
    assert document(again.out)["fruits"] == document(counted_balls.out)["fruits"]
    assert list((again.out / "pictures").iterdir()) == []


@pytest.fixture
def of_another_version(counted_balls: Result, tmp_path: Path) -> Path:
    """The balls' result as a version with another network for offsets left it, and no cache."""
    folder = tmp_path / "older"
    shutil.copytree(counted_balls.out, folder, ignore=shutil.ignore_patterns("cache"))
    kept = load_photo_features(folder / PHOTOS)
    other = replace(kept, offsets=-kept.offsets, encoder_id=kept.encoder_id.replace("offsets-", "offsets-0"))
    save_photo_features(folder / PHOTOS, other)
    content = document(folder)
    content["provenance"]["source"] = counted_balls.origin["source"]
    content["files"][PHOTOS] = file_hash(folder / PHOTOS)
    (folder / "fruits.json").write_text(json.dumps(content))
    return folder


def without_photos(folder: Path) -> None:
    """Make a result forget where its photos are."""
    content = document(folder)
    content["provenance"]["source"] = str(folder / "gone")
    (folder / "fruits.json").write_text(json.dumps(content))


def test_features_of_photos_by_other_weights_are_computed_again(
    counted_balls: Result, of_another_version: Path, tmp_path: Path
) -> None:
    again = count_scene(of_another_version, ["apple"], tmp_path / "again", config=balls_config())
    assert (again.out / PHOTOS).read_bytes() == (counted_balls.out / PHOTOS).read_bytes()
    assert document(again.out)["fruits"] == document(counted_balls.out)["fruits"]


def of_unknown_scales(folder: Path) -> None:
    """Change a result to one of the versions that did not keep the scales at which photos were encoded."""
    with safe_open(folder / PHOTOS, "pt") as file:
        metadata, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    text = json.dumps(metadata).replace("photo-features-4", "photo-features-3")
    del tensors["scales"]
    save_file(tensors, folder / PHOTOS, json.loads(text))
    content = document(folder)
    content["files"][PHOTOS] = file_hash(folder / PHOTOS)
    (folder / "fruits.json").write_text(json.dumps(content))


@pytest.fixture
def of_an_earlier_size(counted_balls: Result, tmp_path: Path) -> Path:
    folder = tmp_path / "older"
    shutil.copytree(counted_balls.out, folder, ignore=shutil.ignore_patterns("cache"))
    content = document(folder)
    content["provenance"]["source"] = counted_balls.origin["source"]
    (folder / "fruits.json").write_text(json.dumps(content))
    of_unknown_scales(folder)
    return folder


def test_photos_that_an_earlier_version_encoded_are_encoded_again_and_a_note_says_so(
    counted_balls: Result, of_an_earlier_size: Path, tmp_path: Path
) -> None:
    again = count_scene(of_an_earlier_size, ["apple"], tmp_path / "again", config=balls_config())
    assert (again.out / PHOTOS).read_bytes() == (counted_balls.out / PHOTOS).read_bytes()
    assert any("encoded large photos at 960 pixels a side" in notice for notice in again.notices)
    assert not any("960 pixels" in notice for notice in counted_balls.notices)


def test_an_earlier_versions_features_are_used_with_the_note_where_the_photos_are_missing(
    counted_balls: Result, of_an_earlier_size: Path, tmp_path: Path
) -> None:
    without_photos(of_an_earlier_size)
    again = count_scene(of_an_earlier_size, ["apple"], tmp_path / "again", config=balls_config())
    assert document(again.out)["fruits"] == document(counted_balls.out)["fruits"]
    assert any("small fruit may be missing" in notice for notice in again.notices)


def test_features_that_were_computed_again_are_reused(of_another_version: Path, tmp_path: Path) -> None:
    first = count_scene(of_another_version, ["apple"], tmp_path / "again", config=balls_config())
    (kept,) = (first.out / "cache").glob(f"pixels-*/{PHOTOS}")
    written = kept.stat().st_mtime_ns
    count_scene(of_another_version, ["pear"], tmp_path / "again", config=balls_config())
    assert kept.stat().st_mtime_ns == written


def test_features_of_photos_by_other_weights_are_not_joined_where_the_photos_are_missing(
    of_another_version: Path, tmp_path: Path
) -> None:
    without_photos(of_another_version)
    again = count_scene(of_another_version, ["apple"], tmp_path / "again", config=balls_config())
    assert any("fruit that Gaussians lose were not counted" in notice for notice in again.notices)
    assert PHOTOS not in document(again.out)["files"]
    assert not (again.out / PHOTOS).exists()


def test_a_result_without_features_of_photos_gets_them_from_its_photos(
    counted_balls: Result, of_another_version: Path, tmp_path: Path
) -> None:
    content = document(of_another_version)
    del content["files"][PHOTOS]
    (of_another_version / PHOTOS).unlink()
    (of_another_version / "fruits.json").write_text(json.dumps(content))
    again = count_scene(of_another_version, ["apple"], tmp_path / "again", config=balls_config())
    assert (again.out / PHOTOS).read_bytes() == (counted_balls.out / PHOTOS).read_bytes()


def test_a_verifier_of_other_networks_is_refused_before_anything_is_trained(
    balls: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(EmbeddedEncoder, "fruit_identity", "embedded-1+offsets-2")
    with pytest.raises(EncoderError, match=r"trained for embedded-\w+\+offsets-\w+, not for embedded-1\+offsets-2"):
        count_scene(balls, ["apple"], tmp_path / "out", config=balls_config())
    assert not (tmp_path / "out").exists()


def test_a_later_count_calls_a_fruit_what_an_earlier_one_called_it(counted_balls: Result, tmp_path: Path) -> None:
    shutil.copytree(counted_balls.out, tmp_path / "out")
    changed = document(tmp_path / "out")
    for fruit in changed["fruits"]:
        fruit["id"] += 100
    (tmp_path / "out" / "fruits.json").write_text(json.dumps(changed | {"last_id": 500}))
    again = count_scene(tmp_path / "out", ["apple"], tmp_path / "out", config=balls_config())
    before = {tuple(fruit["center"]): fruit["id"] for fruit in changed["fruits"]}
    assert document(again.out)["last_id"] >= 500
    for fruit in document(again.out)["fruits"]:
        near = [
            i for c, i in before.items() if np.linalg.norm(np.subtract(c, fruit["center"])) < 0.1 * fruit["diameter"]
        ]
        assert fruit["id"] in near or (not near and fruit["id"] > 500)


def test_every_gaussian_says_how_likely_it_is_and_whose(counted_balls: Result) -> None:
    said = load_file(counted_balls.out / "selection.safetensors")
    assert (said["probability"].dtype, said["fruit_id"].dtype) == (np.float32, np.int32)
    np.testing.assert_array_equal(said["probability"], counted_balls.probability.numpy())
    for fruit in counted_balls.fruit_count.fruits:
        np.testing.assert_array_equal(np.flatnonzero(said["fruit_id"] == fruit.id), fruit.members)
    assert (said["fruit_id"] == -1).sum() == len(counted_balls.gaussians) - sum(
        len(fruit.members) for fruit in counted_balls.fruit_count.fruits
    )
    assert "selection.safetensors" in document(counted_balls.out)["files"]


def test_a_count_of_other_objects_between_takes_no_fruit_its_number(counted_balls: Result, tmp_path: Path) -> None:
    shutil.copytree(counted_balls.out, tmp_path / "out")
    nothing = count_scene(tmp_path / "out", ["lemon"], tmp_path / "out", config=balls_config())
    assert nothing.fruit_count.count == 0
    again = count_scene(tmp_path / "out", ["apple"], tmp_path / "out", config=balls_config())
    assert document(again.out)["fruits"] == document(counted_balls.out)["fruits"]


def test_a_torn_result_folder_is_refused(counted_balls: Result, tmp_path: Path) -> None:
    shutil.copytree(counted_balls.out, tmp_path / "torn", ignore=shutil.ignore_patterns("cache"))
    (tmp_path / "torn" / "gaussians.ply").write_bytes(b"ply\n")
    with pytest.raises(OutputError, match=r"gaussians\.ply"):
        count_scene(tmp_path / "torn", ["apple"], tmp_path / "out")


def test_a_result_folder_refuses_other_training_settings(counted_balls: Result, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"made with --train\.steps 150, not 7"):
        count_scene(counted_balls.out, ["apple"], tmp_path, config=Config(train=TrainConfig(steps=7)))


def test_an_unknown_word_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    with pytest.raises(VocabularyError, match="apple"):
        count_scene(SAMPLE, ["aple"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_prompt_that_a_negative_rules_out_is_refused_before_anything_is_trained(tmp_path: Path) -> None:
    with pytest.raises(VocabularyError, match="is excluded by"):
        count_scene(SAMPLE, ["red apple"], tmp_path / "out", negatives=["apple"])
    assert not (tmp_path / "out").exists()


def test_a_known_word_that_nothing_satisfies_is_a_counted_zero(counted_balls: Result, tmp_path: Path) -> None:
    config = Config(train=balls_config().train, count=CountConfig(threshold=0.999999))
    nothing = count_scene(counted_balls.out, ["purple mango"], tmp_path, config=config)
    content = document(nothing.out)
    assert content["count"] == 0
    assert 0.0 <= content["audit"]["max_probability"] < 0.999999
    assert content["audit"]["clusters"][0]["reason"]


def test_a_cancel_leaves_the_earlier_result_as_it_was(counted_balls: Result, tmp_path: Path) -> None:
    shutil.copytree(counted_balls.out, tmp_path / "out")
    before = {path: path.read_bytes() for path in (tmp_path / "out").glob("*.*")}

    def stop(fraction: float, message: str) -> None:
        if fraction > 0.95:
            raise Cancelled

    with pytest.raises(Cancelled):
        count_scene(tmp_path / "out", ["leaf"], tmp_path / "out", progress=stop)
    assert {path: path.read_bytes() for path in (tmp_path / "out").glob("*.*")} == before


def test_progress_never_goes_back_and_ends_at_one(counted_balls: Result, tmp_path: Path) -> None:
    fractions: list[float] = []
    count_scene(counted_balls.out, ["leaf"], tmp_path, progress=lambda fraction, message: fractions.append(fraction))
    assert np.all(np.diff(fractions) >= 0)
    assert fractions[-1] == 1.0


def test_a_taught_word_whose_fruit_touch_is_said_to_be_no_word_for_bunches(counted_balls: Result) -> None:
    counted = counted_balls.fruit_count
    touching: list[Fruit] = [replace(fruit, kind="compound-part") for fruit in counted.fruits]
    bunched = replace(counted, fruits=touching)
    [sentence] = note_clumped(bunched, {"grape": "1"})
    assert sentence.startswith(f"{len(touching)} of {len(touching)} fruit touch others")
    assert note_clumped(bunched, {}) == note_clumped(counted, {"grape": "1"}) == []


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk past four trees of five balls each."""
    balls, walk = ball_scene.row_of_balls(4), ball_scene.row_poses(4, 40)
    return ball_scene.write_scene(tmp_path_factory.mktemp("row") / "row", balls=balls, walk=walk)


def row_config(sections: int) -> Config:
    config = balls_config()
    return replace(config, scene=SceneConfig(sections=sections), count=replace(config.count, trees=4))


@pytest.fixture(scope="module")
def row_in_sections(row: Path, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return count_scene(row, ["apple"], tmp_path_factory.mktemp("sections"), config=row_config(2))


def test_a_row_in_sections_has_the_fruit_of_the_whole_and_none_twice(
    row: Path, row_in_sections: Result, tmp_path: Path
) -> None:
    whole = count_scene(row, ["apple"], tmp_path / "whole", config=row_config(1))
    sections, together = ([tree.count for tree in each.fruit_count.trees] for each in (row_in_sections, whole))
    assert sum(sections) >= sum(together) - 1
    assert min(sections) >= 3
    found, truth = row_in_sections.fruit_count, read_truth(row / "truth.json")
    assert count_metrics(found.centers, found.diameters, truth, 0.5).doubles == 0


def test_a_row_in_sections_lists_them_and_keeps_the_quality_of_each(row_in_sections: Result) -> None:
    training = document(row_in_sections.out)["provenance"]["training"]
    assert [section["steps"] for section in training["sections"]] == [150] * 2
    assert training["gaussians"] == len(row_in_sections.gaussians) > 3000
    names = [view["view"] for view in training["held_out"]]
    assert len(names) == len(set(names)) >= 4
    for name in QUALITIES:
        assert training[name] == pytest.approx(np.mean([view[name] for view in training["held_out"]]), abs=1e-3)
    cache = row_in_sections.out / "cache"
    assert len(list(cache.glob("train-*"))) == 1  # those of the sections are gone


def test_a_row_that_was_killed_goes_on_with_the_section_that_was_interrupted(
    row: Path, row_in_sections: Result, tmp_path: Path
) -> None:
    told: list[str] = []

    def until_the_second(share: float, text: str) -> None:
        if text.startswith("section 2"):
            raise Cancelled
        told.append(text)

    with pytest.raises(Cancelled):
        reconstruct_scene(row, tmp_path / "out", config=row_config(2), progress=until_the_second)
    assert any(text.startswith("section 1 of 2: ") for text in told)

    def until_features(share: float, text: str) -> None:
        if told and told[-1].startswith("section 2") and not text.startswith("section"):
            raise Cancelled
        told.append(text)

    told.clear()
    with pytest.raises(Cancelled):
        reconstruct_scene(row, tmp_path / "out", config=row_config(2), progress=until_features)
    assert not [text for text in told if text.startswith("section 1")]
    (joined,) = (tmp_path / "out" / "cache").glob("train-*")
    assert (joined / "gaussians.ply").read_bytes() == (row_in_sections.out / "gaussians.ply").read_bytes()
