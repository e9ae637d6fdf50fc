"""The ladder climbed on a scene of five red balls: every rung that needs no structure from motion."""

from __future__ import annotations

import csv
import importlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import ball_scene
import numpy as np
import pytest
from PIL import Image

from fruitlangs.benchmarks.ladder.ladder import StageResult, climb
from fruitlangs.benchmarks.ladder.pages import measure_losses, stage_rows
from fruitlangs.benchmarks.ladder.stages import (
    COUNTING_ONLY,
    END_TO_END,
    TRUE_GEOMETRY,
    TRUE_MASKS,
    TRUE_POSES,
    LadderStages,
)
from fruitlangs.benchmarks.markdown import markdown
from fruitlangs.engine.config import Config, CountConfig, TrainConfig
from fruitlangs.engine.counting.evidence.pixel_width import focal_length
from fruitlangs.engine.errors import FormatError, SceneError, VocabularyError
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.evaluation.truth import read_truth, read_views
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.language.features.embedder import Embedder
from fruitlangs.engine.photo_size import scales_for

COUNT = CountConfig(diameter=0.2, sample_budget=5000)
QUICK = Config(train=TrainConfig(steps=60, max_gaussians=4000), count=COUNT)
FLAGS = ["--train.steps", "60", "--train.max-gaussians", "4000", "--count.diameter", "0.2"]
FLAGS += ["--count.sample-budget", "5000", "--stages", COUNTING_ONLY, TRUE_MASKS]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_scene.write_scene(tmp_path_factory.mktemp("ladder") / "balls", views=10)


@pytest.fixture(scope="module")
def evaluated(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("evaluated")
    importlib.import_module("evaluate").main([str(scene), "--out", str(out), *FLAGS])
    return out


def rows_of(out: Path) -> list[dict[str, str]]:
    with (out / "ladder.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def copied(scene: Path, to: Path) -> Path:
    shutil.copytree(scene, to)
    return to


def test_true_masks_on_true_and_on_trained_geometry_find_the_balls(evaluated: Path) -> None:
    rows = {row["ablation_stage"]: row for row in rows_of(evaluated)}
    assert [rows[COUNTING_ONLY][name] for name in ("species", "seed", "visible", "f1")] == ["apple", "7", "5", "1.0000"]
    assert float(rows[TRUE_MASKS]["f1"]) >= 0.8
    assert float(rows[TRUE_MASKS]["psnr"]) > 5
    assert rows[COUNTING_ONLY]["psnr"] == ""


def test_a_stage_has_our_estimate_of_all_fruit_within_its_interval(evaluated: Path) -> None:
    row = next(row for row in rows_of(evaluated) if row["ablation_stage"] == COUNTING_ONLY)
    low, estimate, high = (float(row[f"total_{name}"]) for name in ("low", "estimate", "high"))
    assert 5 <= low <= estimate <= high


def test_the_pages_hold_tables_plot_and_mistakes(evaluated: Path) -> None:
    assert "loses most" in (evaluated / "ladder.md").read_text(encoding="utf-8")
    page = (evaluated / "index.html").read_text(encoding="utf-8")
    assert "balls/mistakes_counting-only.png" in page
    for name in ("ladder.png", f"balls/mistakes_{COUNTING_ONLY}.png"):
        assert min(Image.open(evaluated / name).size) > 10


def test_a_second_run_takes_what_the_first_counted_and_writes_the_same_bytes(
    evaluated: Path, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = {name: (evaluated / name).read_bytes() for name in ("ladder.csv", "visibility.csv", "ladder.md")}

    def refuse(*_: object) -> None:
        raise AssertionError("a finished rung was run again")

    monkeypatch.setattr(LadderStages, "run", refuse)
    importlib.import_module("evaluate").main([str(scene), "--out", str(evaluated), *FLAGS])
    assert {name: (evaluated / name).read_bytes() for name in before} == before


def test_other_settings_are_counted_again(evaluated: Path, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        LadderStages, "run", lambda self, name, progress: asked.append(name) or (_ for _ in ()).throw(STOP)
    )
    out = evaluated / "balls"
    climb(scene, out, config=QUICK, stages=[COUNTING_ONLY])
    assert asked == []
    climb(scene, out, config=replace(QUICK, train=TrainConfig(steps=61, max_gaussians=4000)), stages=[COUNTING_ONLY])
    assert asked == [COUNTING_ONLY]


STOP = SceneError("stopped here")


def test_a_stage_that_fails_is_no_count_and_the_others_continue(scene: Path, tmp_path: Path) -> None:
    broken = copied(scene, tmp_path / "broken")
    (broken / "depth" / "003.png").unlink()
    rows = climb(broken, tmp_path / "out", config=QUICK, stages=[COUNTING_ONLY, TRUE_MASKS])
    assert (rows[0].counted, rows[0].near) == (None, None)
    assert "003.png is missing" in rows[0].failed
    assert rows[1].near is not None
    assert "failed" in markdown(stage_rows(rows))


def test_a_scene_without_truth_is_counted_and_not_measured(scene: Path, tmp_path: Path) -> None:
    bare = copied(scene, tmp_path / "bare")
    (bare / "truth.json").unlink()
    said: list[str] = []
    rows = climb(bare, tmp_path / "out", config=QUICK, stages=[COUNTING_ONLY, TRUE_POSES], report=said.append)
    assert [(row.stage, row.near) for row in rows] == [(TRUE_POSES, None)]
    assert rows[0].counted is not None
    assert "no truth.json" in said[0]


def test_a_truth_of_other_images_fails_before_anything_is_counted(scene: Path, tmp_path: Path) -> None:
    other = copied(scene, tmp_path / "other")
    document = json.loads((other / "truth.json").read_text())
    for fruit in document["fruits"]:
        fruit["center"][0] += 1.0
    (other / "truth.json").write_text(json.dumps(document))
    row = climb(other, tmp_path / "out", config=QUICK, stages=[COUNTING_ONLY])[0]
    assert "the truth of another scene" in row.failed


def test_a_half_made_scene_is_refused(scene: Path, tmp_path: Path) -> None:
    half = copied(scene, tmp_path / "half")
    (half / "orchard.json").write_text('{"config": {"species": "apple", "seed": 1}}')
    with pytest.raises(FormatError, match="incomplete"):
        climb(half, tmp_path / "out", config=QUICK)


def test_a_scene_that_does_not_say_what_grows_there_needs_a_prompt(scene: Path, tmp_path: Path) -> None:
    unknown = copied(scene, tmp_path / "unknown")
    (unknown / "orchard.json").unlink()
    with pytest.raises(VocabularyError, match="--prompt"):
        climb(unknown, tmp_path / "out", config=QUICK)


def test_noisy_poses_are_put_right_by_the_truths_own(scene: Path, tmp_path: Path) -> None:
    noisy = copied(scene, tmp_path / "noisy")
    document = json.loads((noisy / "truth.json").read_text())
    views = [
        {"name": f"{k:03d}.png", "world_to_camera": pose[:3].tolist()} for k, pose in enumerate(ball_scene.poses(10))
    ]
    (noisy / "truth.json").write_text(json.dumps({**document, "views": views}))
    model = json.loads((noisy / "transforms.json").read_text())
    for frame in model["frames"]:
        frame["transform_matrix"][0][3] += 0.05
    (noisy / "transforms.json").write_text(json.dumps(model))
    truth_file = noisy / "truth.json"
    stages = LadderStages(noisy, tmp_path / "out", read_truth(truth_file), read_views(truth_file), ["apple"], QUICK)
    for camera, pose in zip(stages.scene.cameras, ball_scene.poses(10), strict=True):
        np.testing.assert_allclose(camera.world_to_camera, pose, atol=1e-9)
    assert stages.run(COUNTING_ONLY, lambda *_: None).centers.shape == (5, 3)


@pytest.mark.parametrize(("angle", "share"), [(44.0, 0.5), (14.0, 1.0)])
def test_true_masks_become_maps_of_the_size_that_the_encoder_gives_at_the_scales_of_a_run(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, angle: float, share: float
) -> None:
    stages = LadderStages(scene, tmp_path / "out", read_truth(scene / "truth.json"), [], ["apple"], QUICK)
    # Fruit are `angle` pixels wide.
    focal = focal_length(stages.scene.cameras[0])
    monkeypatch.setattr("fruitlangs.engine.photo_size.fruit_angle", lambda *_: angle / focal)
    maps = stages._make_true_maps(stages.scene)
    assert maps is not None
    for found, ids in zip(maps, stages.instances, strict=True):
        size = tuple(round(side * share) for side in ids.shape)
        assert found.probability.shape == found.offsets.shape[:2] == size
        fruit = (ids > 0).astype(np.float64)
        assert found.probability.mean() == pytest.approx(fruit.mean(), rel=0.02)
        if share == 1.0:
            np.testing.assert_array_equal(found.probability, fruit)
        else:
            assert np.any((found.probability > 0.2) & (found.probability < 0.8))


def test_the_stage_with_true_geometry_lifts_features_at_the_scales_of_a_run(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stages = LadderStages(scene, tmp_path / "out", read_truth(scene / "truth.json"), [], ["apple"], QUICK)
    expected = scales_for(stages.scene.cameras, 0.1, EmbeddedEncoder.open())
    monkeypatch.setattr("fruitlangs.engine.photo_size.fruit_angle", lambda *_: 0.1)
    given = []
    lift = Embedder.lift
    monkeypatch.setattr(Embedder, "lift", lambda *_, **named: given.append(named["scales"]) or lift(*_, **named))
    stages.run(TRUE_GEOMETRY, lambda *_: None)
    assert given == [expected]


def test_the_stage_that_loses_most_is_named() -> None:
    assert (
        measure_losses({COUNTING_ONLY: 0.98, TRUE_MASKS: 0.95, TRUE_POSES: 0.80, END_TO_END: 0.78}).largest == "masks"
    )
    assert measure_losses({COUNTING_ONLY: 0.90, TRUE_MASKS: 0.95}).largest == "counting"
    assert measure_losses({COUNTING_ONLY: 1.0}).largest == ""


def test_the_earlier_name_of_the_flag_of_stages_is_read() -> None:
    parse = importlib.import_module("evaluate").parse
    for flag in ("--stages", "--rungs"):
        assert parse(["scene", "--out", "out", flag, TRUE_POSES, END_TO_END]).stages == (TRUE_POSES, END_TO_END)


def test_means_leave_out_what_failed(scene: Path) -> None:
    truth = read_truth(scene / "truth.json")
    all_found = count_metrics(truth.centers, truth.diameters, truth)
    common = {"species": "apple", "seed": 1, "stage": TRUE_POSES}
    rows = [
        StageResult(scene="a", counted=5, near=all_found, **common),
        StageResult(scene="b", counted=None, failed="no", **common),
    ]
    mean = next(line for line in stage_rows(rows) if line[0] == "mean F1")
    assert "1.000 (1 of 2)" in mean
