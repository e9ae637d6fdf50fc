"""Fitting the gate that tells fruit from what is none."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import ball_scene
import fit_gate
import numpy as np
import pytest

from fruitlangs.benchmarks.counting.simulated import Setting, simulate
from fruitlangs.engine.counting.evidence.gate import WEIGHED
from fruitlangs.engine.counting.evidence.pixel_width import focal_length
from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.language.encoders.embedded import EmbeddedEncoder
from fruitlangs.engine.scene.read import read_scene
from fruitlangs.fitting.counting.cases import Case, encode, iterate_rendered_cases, iterate_surface_cases
from fruitlangs.fitting.encoder.pictures import LEAST_WALK

ROOT = Path(__file__).resolve().parents[2]

FEW = Setting(fruits=(25, 25), leaves=400, wrong=0.1, views=10)


def drawn(kind: str, family: str, seed: int, truth: float = 2.0) -> fit_gate.Example:
    """Candidates of which those with a high first feature are fruit."""
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(400, len(WEIGHED)))
    fruit = truth * features[:, 0] + rng.logistic(size=400) > 0.0
    return fit_gate.Example(kind, family, features, fruit, np.ones(400), int(fruit.sum()) + 10)


def test_the_regression_finds_what_gives_fruit_and_what_does_not():
    gate = fit_gate.fit([drawn("sparse", f"crown {1000 + seed}", seed) for seed in range(6)])
    assert gate.linear[0] == pytest.approx(2.0, rel=0.15)
    assert np.abs(gate.linear[1:]).max() < 0.2
    assert np.abs(gate.quadratic).max() < 0.25


def test_the_regression_finds_what_gives_fruit_only_together():
    rng = np.random.default_rng(0)
    features = rng.normal(size=(2000, len(WEIGHED)))
    fruit = 2.0 * features[:, 1] * features[:, 2] + rng.logistic(size=2000) > 0.0
    gate = fit_gate.fit([fit_gate.Example("sparse", "crown 1000", features, fruit, np.ones(2000), 1000)])
    assert gate.quadratic[1, 2] == pytest.approx(1.8, rel=0.2)
    assert np.abs(gate.linear).max() < 0.25


def test_a_few_rendered_trees_weigh_as_much_as_many_crowns():
    crowns = [drawn("sparse", f"crown {1000 + seed}", seed) for seed in range(8)]
    gate = fit_gate.fit([*crowns, drawn("walk, encoder", "walk 1314", 9, truth=-2.0)])
    assert abs(gate.linear[0]) < 0.3


def test_a_scene_is_never_judged_by_a_gate_that_was_fitted_to_it(monkeypatch: pytest.MonkeyPatch):
    fitted: list[set[str]] = []
    fit = fit_gate.fit
    monkeypatch.setattr(fit_gate, "fit", lambda rows: fitted.append({row.family for row in rows}) or fit(rows))
    kinds = (("walk, encoder", "walk 1314"), ("walk, true masks", "walk 1314"), ("sparse", "crown 1000"))
    lines = fit_gate.table([drawn(kind, family, seed) for seed, (kind, family) in enumerate(kinds)]).splitlines()
    assert sorted(map(sorted, fitted)) == [["crown 1000"], ["walk 1314"]]
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| walk, encoder", "| walk, true masks", "| sparse"]


def test_candidates_of_a_crown_are_fruit_and_others(tmp_path: Path):
    crown = simulate(FEW, 1003)
    given = (crown.gaussians, crown.probability, crown.cameras, crown.truth, crown.shown)
    (example,) = fit_gate.make_example(Case("few", "crown 1003", *given))
    assert example.features.shape == (len(example.fruit), len(WEIGHED))
    assert example.fruit.sum() >= 0.9 * example.visible
    assert not example.fruit.all()
    precision, recall, f1, promised = fit_gate.judge_example(example, fit_gate.fit([example]))
    assert min(precision, recall, f1) > 0.9
    assert promised == pytest.approx(1.0, abs=0.1)


def test_true_surfaces_of_a_rendered_tree_are_fitted_to_as_well_as_trained_ones(tmp_path: Path):
    ball_scene.write_scene(tmp_path / "1003", views=LEAST_WALK, seed=1003)
    ball_scene.write_scene(tmp_path / "1004", views=LEAST_WALK - 1, seed=1004)
    (case,) = iterate_surface_cases(tmp_path)
    assert (case.kind, case.family, len(case.cameras)) == ("walk, true surfaces", "walk 1003", LEAST_WALK)
    (example,) = fit_gate.make_example(case)
    assert (example.fruit.sum(), example.visible) == (len(ball_scene.BALLS), len(ball_scene.BALLS))


def test_trees_are_encoded_at_the_scales_of_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = read_scene(ball_scene.write_scene(tmp_path / "1003", views=2, seed=1003))
    gaussians = simulate(FEW, 1003).gaussians
    focal = focal_length(scene.cameras[0])
    for width, share in ((44.0, 0.5), (14.0, 1.0)):
        monkeypatch.setattr("fruitlangs.engine.photo_size.fruit_angle", lambda *_, w=width: w / focal)
        _, maps = encode(gaussians, scene, "apple", EmbeddedEncoder.open())
        assert maps is not None
        sizes = {each.probability.shape for each in maps}
        assert sizes == {(round(camera.height * share), round(camera.width * share)) for camera in scene.cameras}


@pytest.mark.parametrize("cases", [iterate_rendered_cases, iterate_surface_cases])
def test_rendered_trees_of_seeds_for_tests_are_refused_before_anything_is_trained(
    tmp_path: Path, cases: Callable[[Path], Iterator[Case]]
):
    ball_scene.write_scene(tmp_path / "1003", views=LEAST_WALK, seed=1003)
    ball_scene.write_scene(tmp_path / "7", views=LEAST_WALK, seed=7)
    with pytest.raises(FormatError, match=r"has seed 7, and seeds below 1000 are for tests alone. Take it out"):
        next(cases(tmp_path))


def test_seeds_of_tests_and_tables_are_refused(tmp_path: Path):
    out = tmp_path / "gate.json"
    out.write_text(json.dumps({"kept": True}))
    command = [sys.executable, str(ROOT / "scripts" / "developer" / "fit_gate.py"), "--first", "3", "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: Seeds below 1000 are for tests and tables")
    assert json.loads(out.read_text()) == {"kept": True}
