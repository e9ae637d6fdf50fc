"""The paper's tables on a scene of five red balls."""

from __future__ import annotations

from pathlib import Path

import ball_scene
import numpy as np
import pytest
import torch

from fruitlangs.benchmarks.paper.figures import ABLATIONS, COUNTERS, METHODS, PRINTED
from fruitlangs.benchmarks.paper.fruit_field import learn
from fruitlangs.benchmarks.paper.pages import ablation_table, count_table, reconstruction_table
from fruitlangs.benchmarks.paper.tables import (
    VARIANTS,
    Quality,
    SceneTables,
    Tally,
    measure_tables,
    select_without_language,
)
from fruitlangs.engine.config import Config, CountConfig, TrainConfig
from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.evaluation.renders import read_depths, read_instances
from fruitlangs.engine.evaluation.true_surface import true_surface
from fruitlangs.engine.scene.read import read_scene

QUICK = Config(train=TrainConfig(steps=30, max_gaussians=3000), count=CountConfig(diameter=0.2, sample_budget=5000))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return ball_scene.write_scene(tmp_path_factory.mktemp("tables") / "balls", views=10)


@pytest.fixture(scope="module")
def tables(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> SceneTables:
    return measure_tables(scene, tmp_path_factory.mktemp("out"), config=QUICK)


def test_every_training_of_the_paper_has_its_quality(tables: SceneTables) -> None:
    assert list(tables.reconstruction) == list(VARIANTS)
    assert all(row.psnr is not None and row.psnr > 5 and row.fps > 0 for row in tables.reconstruction.values())


def test_other_reconstructions_and_fields_are_counted(tables: SceneTables) -> None:
    cloud = tables.counts["NeRF+Ours"]
    assert (cloud.counted is not None, cloud.note) == (True, "points of true depths in NeRF's place")
    assert tables.counts["3DGS+Ours"].note == "our training without eq. 3 and 4"
    assert tables.counts["3DGS+Ours"].true == 5
    assert tables.counts["FruitNeRF"].true == tables.ablation["Fruit Field"].true == 5
    assert tables.ablation["without language"].counted is not None


def test_a_fruit_field_learns_which_gaussians_the_masks_show(scene: Path) -> None:
    posed = read_scene(scene)
    ids = read_instances(scene, posed)
    surface = true_surface(posed, read_depths(scene, posed), ids)
    masks = [torch.from_numpy(each > 0) for each in ids]
    field = learn(surface.gaussians, posed.cameras, masks).numpy()
    assert field[surface.fruit > 0].mean() > 0.8
    assert field[surface.fruit == 0].mean() < 0.1
    assert np.array_equal(field, learn(surface.gaussians, posed.cameras, masks).numpy())


def test_without_language_ground_and_surroundings_are_cut_and_balls_pass(scene: Path) -> None:
    posed = read_scene(scene)
    surface = true_surface(posed, read_depths(scene, posed), read_instances(scene, posed))
    passed = select_without_language(surface.gaussians, posed).numpy() > 0
    away = np.linalg.norm(surface.gaussians.means.numpy() - posed.middle, axis=1)
    assert passed[surface.fruit > 0].mean() > 0.9
    assert passed[surface.fruit == 0].mean() < 0.05
    assert not passed[away > posed.spread].any()


def test_a_scene_that_does_not_say_what_grows_there_needs_a_prompt(scene: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    with pytest.raises(FormatError, match="--prompt"):
        measure_tables(bare, tmp_path / "out", config=QUICK)


def test_a_scene_of_the_papers_name_stands_next_to_what_the_paper_printed() -> None:
    quality = dict.fromkeys(VARIANTS, Quality(ssim=0.5, psnr=20.0, fps=3.0))
    named = SceneTables(
        name="Tree01",
        reconstruction=quality,
        counts={"Ours": Tally(counted=170, true=179, f1=0.9)},
        ablation={"with language": Tally(counted=170), "Fruit Field": Tally(note="not measured")},
    )
    other = SceneTables(name="mine", reconstruction=quality, counts=named.counts, ablation=named.ablation)
    text = reconstruction_table([named, other])
    assert (
        "| Tree01 | PSNR / dB ↑ | 20.00 | 20.00 | 20.00 | 20.00 | 16.402 | 16.61 | 17.616 | 18.072 | 17.947 |" in text
    )
    assert "988.86" in text
    assert "not measured" in text
    assert "| Tree01 | 170 (95.0%), F1 0.900 | 179 | 140 | 154 | 173 | 173 | 179 |" in count_table([named, other])
    assert "| Tree01 | 170 | not measured |" in ablation_table([named])
    for table in (text, count_table([named, other]), ablation_table([named, other])):
        widths = {line.count("|") for line in table.splitlines() if line.startswith("|")}
        assert len(widths) == 1
    assert "[" not in count_table([other])


def test_the_printed_tables_are_whole() -> None:
    for printed in PRINTED.values():
        assert {len(printed.ssim), len(printed.psnr), len(printed.lpips), len(printed.fps)} == {len(METHODS)}
        assert len(printed.counts) == len(COUNTERS)
        assert len(printed.ablation) in (0, len(ABLATIONS))
