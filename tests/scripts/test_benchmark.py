"""The benchmark measures what it says, against a peer that draws the same picture."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import bumpy_wall
import numpy as np
import pytest
import torch
from checkpoints import write_clip

from fruitlangs.benchmarks.cameras import SEARCH_STAGES, camera_table, measure_cameras
from fruitlangs.benchmarks.counting.speed import make_crown, measure_counting
from fruitlangs.benchmarks.language import measure_language
from fruitlangs.benchmarks.stopwatch import Stopwatch
from fruitlangs.benchmarks.training import plain_rasterizer, published_3dgs
from fruitlangs.benchmarks.training.ablation import VARIANTS, ablate
from fruitlangs.benchmarks.training.curve import training_curve
from fruitlangs.benchmarks.training.pages import (
    ablation_table,
    curve_table,
    draw_curves,
    draw_stages,
    published_table,
    stage_table,
    watched_table,
)
from fruitlangs.benchmarks.training.published_3dgs import compare_with_published, train_published
from fruitlangs.benchmarks.training.step_times import (
    FORWARD_AND_BACKWARD,
    STAGES,
    STEP,
    Setting,
    look_ahead,
    make_orchard_like,
    measure,
)
from fruitlangs.engine.config import CountConfig, EmbedConfig, SceneConfig, TrainConfig
from fruitlangs.engine.counting.sizing import fruit_size
from fruitlangs.engine.errors import CountingError, SceneError
from fruitlangs.engine.progress import silent
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.gaussians import PARAMETERS
from fruitlangs.engine.splatting.ply import write_ply
from fruitlangs.engine.splatting.rendering.rasterize import render
from fruitlangs.engine.splatting.rendering.workspace import Workspace
from fruitlangs.engine.splatting.training.initialise import initialise_gaussians
from fruitlangs.engine.splatting.training.losses import PhotometricLoss
from fruitlangs.engine.splatting.training.photos import PhotoShelf

ROOT = Path(__file__).resolve().parents[2]

SAMPLE = ROOT / "examples" / "orchard_tree"
SMALL = SceneConfig(downscale=6)
SHORT = TrainConfig(steps=40, max_gaussians=3000, sh_degree=0, densify_every=10)


def test_the_peer_draws_the_same_picture_and_pulls_the_same_way() -> None:
    gaussians, camera = make_orchard_like(400), look_ahead(80, 60)
    leaves = {name: getattr(gaussians, name).clone().requires_grad_() for name in PARAMETERS}
    view = plain_rasterizer.View.of(camera.K, camera.world_to_camera, camera.width, camera.height)
    splats = plain_rasterizer.project(leaves, view)
    theirs = plain_rasterizer.blend(splats, *plain_rasterizer.tile_lists(splats, 80, 60), 80, 60)
    ours_in = {name: getattr(gaussians, name).clone().requires_grad_() for name in PARAMETERS}
    ours = render(type(gaussians)(**ours_in), camera).color
    assert float((ours - theirs).detach().abs().mean()) < 0.004  # its boxes end at three standard deviations
    theirs.sum().backward()
    ours.sum().backward()
    a, b = (side["opacity_logits"].grad for side in (ours_in, leaves))
    assert a is not None
    assert b is not None
    assert float(torch.nn.functional.cosine_similarity(a, b, dim=0)) > 0.99


def test_the_loss_of_the_baseline_equals_ours() -> None:
    random = np.random.default_rng(0)
    image, photo = random.random((3, 30, 40)).astype(np.float32), random.integers(0, 256, (30, 40, 3), dtype=np.uint8)
    ours = PhotometricLoss(0.2, Workspace()).backward(image, photo, None, np.empty_like(image))
    theirs = plain_rasterizer.loss(torch.from_numpy(image).permute(1, 2, 0), torch.from_numpy(photo).float() / 255)
    assert ours == pytest.approx(float(theirs), rel=1e-4)


def test_every_setting_has_a_row_a_stage_and_the_sums(tmp_path: Path) -> None:
    rows = measure([Setting(300, 64, 48, 1), Setting(300, 64, 48, 2)], repeats=2)
    assert [row.stage for row in rows[:8]] == [*STAGES, FORWARD_AND_BACKWARD, STEP]
    assert [row.threads for row in rows] == [1] * 8 + [2] * 8
    for row in rows:
        assert row.seconds > 0
        assert row.baseline is not None
        assert row.baseline_ratio == pytest.approx(row.baseline / row.seconds)
    assert stage_table(rows).count("\n| 300 |") == 2
    draw_stages(rows, tmp_path / "stages.png")
    assert (tmp_path / "stages.png").stat().st_size > 1000


def test_a_peer_that_does_not_fit_leaves_its_columns_empty() -> None:
    rows = measure([Setting(300, 64, 48, 1)], repeats=1, baseline_memory=1000)
    assert all(row.baseline is None and row.baseline_ratio is None for row in rows)
    assert "|  |" in stage_table(rows)


def test_a_curve_has_seconds_that_grow_and_ends_with_the_training(tmp_path: Path) -> None:
    curve = training_curve(SAMPLE, replace(SHORT, steps=240), scene_config=SMALL)
    assert curve.steps == 240
    assert len(curve.seconds) == len(curve.psnr) > 10
    assert list(curve.seconds) == sorted(curve.seconds)
    assert curve.psnr[-1] > curve.psnr[0]
    assert "| orchard_tree |" in curve_table([curve])
    draw_curves([curve], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 1000


def test_an_ablation_trains_once_for_every_name() -> None:
    names = ["standard", "loss by PyTorch's autograd", "Adam over all Gaussians", "MCMC"]
    rows = ablate(SAMPLE, SHORT, names=names, scene_config=SMALL)
    assert [row.name for row in rows] == names
    assert len({row.psnr for row in rows}) == 4
    assert rows[1].psnr == pytest.approx(rows[0].psnr, abs=1.0)  # the same loss, added up in another order
    assert ablation_table(rows).count("×") == 4


def test_every_variant_is_a_setting_of_training() -> None:
    for change in VARIANTS.values():
        TrainConfig(**change)


def test_3dgs_as_published_learns_a_tiny_scene_and_ours_takes_as_many_gaussians(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(published_3dgs, "DENSIFY_FROM", 50)
    monkeypatch.setattr(published_3dgs, "DENSIFY_EVERY", 20)
    monkeypatch.setattr(published_3dgs, "TrainConfig", partial(TrainConfig, steps=60))
    barely = train_published(read_scene(SAMPLE, SceneConfig(downscale=10)), steps=1, most=300)
    steps = published_3dgs.DENSIFY_FROM + 2 * published_3dgs.DENSIFY_EVERY
    theirs, standard, ours = compare_with_published(SAMPLE, steps=steps, gaussians=300, downscale=10)
    assert theirs.psnr > barely.psnr + 2.0
    assert 100 < theirs.gaussians <= 300
    assert max(standard.gaussians, ours.gaussians) <= theirs.gaussians
    assert (theirs.steps, standard.steps, ours.steps) == (steps, 60, steps)
    assert published_table([theirs, standard, ours]).count("| ours |") == 2


def test_both_encoders_are_timed_stage_by_stage(tmp_path: Path) -> None:
    shelf = PhotoShelf(read_scene(SAMPLE, SMALL))
    write_ply(tmp_path / "gaussians.ply", initialise_gaussians(shelf, range(4), 0, 1000, 0))
    shelf.close()
    clip = write_clip(tmp_path / "clip")
    configs = [EmbedConfig(), EmbedConfig(encoder="clip", clip=str(clip), code_epochs=1)]
    rows = measure_language(SAMPLE, tmp_path / "gaussians.ply", configs, views=2)
    assert {row.pipeline for row in rows} == {"embedded", "clip, classical masks"}
    by_name = {(row.pipeline, row.name): row for row in rows}
    assert by_name["embedded", "encode a photo"].times == 2
    assert by_name["embedded", "measure the width of fruit"].times == 1
    assert by_name["clip, classical masks", "find a photo's masks"].times == 2
    assert all(row.seconds >= 0.0 < row.peak for row in rows)
    assert watched_table("From photos to probabilities.", rows).count("| ask a word |") == 2


def test_a_stage_inside_another_stops_its_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: clock[0])

    def pass_time(seconds: float) -> None:
        clock[0] += seconds

    watch = Stopwatch()
    with watch.stage("outer"):
        for _ in watch.each("inner", (pass_time(0.5) for _ in range(2))):
            pass_time(0.25)
    assert watch.seconds == {"inner": 1.0, "outer": 0.5}
    assert watch.times == {"outer": 1, "inner": 2}


def test_sam_without_clip_is_one_line() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "benchmark.py"), "--language", "a", "b", "--sam", "c"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: --sam")


def test_the_script_writes_rows_as_json(tmp_path: Path) -> None:
    file = tmp_path / "rows.json"
    command = [
        sys.executable, str(ROOT / "scripts" / "benchmark.py"),
        "--memory", "500", "3", "64", "48", "--curve", str(SAMPLE), "--steps", "2", "--json", str(file),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert "Peak memory" in done.stdout
    assert "held-out PSNR" in done.stdout
    assert json.loads(file.read_text()) == []


def test_a_setting_below_one_is_one_line() -> None:
    command = [sys.executable, str(ROOT / "scripts" / "benchmark.py"), "--threads", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: --threads")


def test_counting_is_timed_from_the_size_to_the_description_of_the_fruit() -> None:
    rows = measure_counting([100_000])
    assert [row.name for row in rows] == ["size", "points", "fruit", "account", "describe", "ground", "interval"]
    points, fruit = (int(word.replace(",", "")) for word in rows[0].pipeline.split() if word[0].isdigit())
    assert 0.95 < points / 100_000 < 1.05
    assert 650 < fruit < 800  # of 762 true ones
    with pytest.raises(CountingError, match="numbers of points from 1 on"):
        measure_counting([0])


def test_of_two_thousand_fruit_the_size_is_that_of_one_crown() -> None:
    crown = make_crown()
    sizes = []
    for stack in (crown, crown.repeat(3)):
        size = fruit_size(stack.gaussians, stack.probability, stack.visibility, stack.seen, CountConfig())
        assert size is not None
        sizes.append(size.diameter)
    assert sizes[1] == pytest.approx(sizes[0], rel=0.05)


def test_the_camera_search_is_timed_by_stage_for_each_number_of_photos(tmp_path: Path) -> None:
    for view in range(5):
        bumpy_wall.render(view).save(tmp_path / f"{view}.png")
    rows = measure_cameras(tmp_path, [4, 5], progress=silent)
    assert [(row.photos, row.placed) for row in rows] == [(4, 4), (5, 5)]
    assert all(0.0 < sum(row.stages.values()) < row.seconds for row in rows)
    assert set(rows[0].stages) == set(SEARCH_STAGES)
    assert 3 <= rows[0].pairs <= 6
    assert camera_table(rows).count("\n") == 3


def test_more_photos_than_there_are_cannot_be_timed(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="has 0 photos"):
        measure_cameras(tmp_path, [4], progress=silent)
