"""F1 against the width of fruit in photos."""

from __future__ import annotations

from pathlib import Path

import ball_scene
import numpy as np
import pytest

from fruitlangs.benchmarks import widths
from fruitlangs.benchmarks.widths import (
    WidthRow,
    draw_widths,
    measure_mean_width,
    measure_widths,
    read_widths,
    write_widths,
)
from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.evaluation.renders import read_depths, read_instances
from fruitlangs.engine.evaluation.true_surface import true_surface
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.engine.splatting.ply import write_ply


def row(species: str, width: float, f1: float = 0.5) -> WidthRow:
    return WidthRow(
        species=species,
        seed=1,
        width=width,
        seen=2.0 * width,
        visible=9,
        counted=8,
        recall=f1,
        f1=f1,
        diameter_bias=0.1,
    )


def test_a_tree_is_counted_in_photos_of_fewer_and_fewer_pixels(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ball_scene.write_scene(tmp_path / "apple-1", views=8)
    scene = read_scene(folder, SceneConfig())
    surface = true_surface(scene, read_depths(folder, scene), read_instances(folder, scene))
    write_ply(tmp_path / "gaussians.ply", surface.gaussians)
    own = measure_mean_width(read_truth(folder / "truth.json"), scene.cameras)
    monkeypatch.setattr(widths, "WIDTHS", (own / 2.0, 2.0 * own))
    half, whole = measure_widths(folder, tmp_path / "gaussians.ply")
    assert whole.width == pytest.approx(own)
    assert half.width == pytest.approx(own / 2.0, rel=0.02)
    assert half.visible == whole.visible == len(ball_scene.BALLS)
    assert whole.f1 > 0.7


def test_the_width_is_that_of_the_fruit_in_the_photos(tmp_path: Path) -> None:
    folder = ball_scene.write_scene(tmp_path / "apple-1", views=2)
    (one, _), truth = read_scene(folder, SceneConfig()).cameras, read_truth(folder / "truth.json")
    away = np.linalg.norm(truth.centers - one.center, axis=1)
    assert measure_mean_width(truth, [one]) == pytest.approx(
        np.mean(truth.diameters / away) * ball_scene.FOCAL, rel=0.05
    )


def test_new_rows_of_a_tree_replace_its_earlier_ones_and_keep_those_of_others(tmp_path: Path) -> None:
    path = tmp_path / "widths.json"
    assert read_widths(path) == []
    write_widths([row("plum", 8.0), row("apple", 16.0), row("apple", 6.0)], path)
    write_widths([row("plum", 11.0, 0.75)], path)
    assert read_widths(path) == [row("apple", 6.0), row("apple", 16.0), row("plum", 11.0, 0.75)]


def test_the_picture_is_drawn_alike_each_time(tmp_path: Path) -> None:
    for name in ("one.png", "other.png"):
        draw_widths([row("plum", 8.0), row("plum", 16.0)], tmp_path / name)
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "other.png").read_bytes()
