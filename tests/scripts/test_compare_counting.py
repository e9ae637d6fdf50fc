"""Simulated crowns are what their settings say, and methods are compared on the same ones."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "scripts"))
import _checkout  # noqa: F401

from fruitlangs.benchmarks.rivals import METHODS, surface_of
from fruitlangs.benchmarks.simulated import SETTINGS, Setting, Simulation, simulate
from fruitlangs.benchmarks.simulated_page import Trial, counting_table
from fruitlangs.engine.config import CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.evaluation.judgement import judge
from fruitlangs.engine.evaluation.metrics import count_metrics

FEW = Setting(fruits=(25, 25), leaves=60, views=10)


@pytest.fixture(scope="module")
def crown() -> Simulation:
    return simulate(FEW, 3)


def test_a_seed_is_one_crown(crown: Simulation):
    again, other = simulate(FEW, 3), simulate(FEW, 4)
    assert np.array_equal(again.gaussians.means.numpy(), crown.gaussians.means.numpy())
    assert not np.array_equal(other.truth.centers, crown.truth.centers)


def test_what_is_taken_for_fruit_lies_on_fruit_but_for_some_leaves_and_floaters(crown: Simulation):
    means = crown.gaussians.means.double().numpy()[crown.probability.numpy() > 0.5]
    apart = np.linalg.norm(means[:, None] - crown.truth.centers, axis=2) / (0.5 * crown.truth.diameters)
    near = apart.min(axis=1)
    assert 0.9 < (abs(near - 1.0) < 0.5).mean() < 1.0
    assert 0.85 < np.median(near) < 1.05


def test_leaves_hide_fruit():
    open_, hidden = simulate(replace(FEW, leaves=10), 5).truth, simulate(replace(FEW, leaves=6000), 5).truth
    assert open_.visible_fractions.mean() > 0.9 > 0.6 > hidden.visible_fractions.mean()


def test_half_a_ring_is_seen_from_one_side():
    sides = [np.stack([camera.center for camera in simulate(replace(FEW, arc=arc), 1).cameras]) for arc in (360, 180)]
    assert sides[0][:, 1].min() < -10.0
    assert sides[1][:, 1].min() > 0.0


def test_drift_doubles_surfaces():
    def thickness(drift: float) -> float:
        crown = simulate(replace(FEW, drift=drift, noise=(0.0, 0.0), floaters=0.0, wrong=0.0), 2)
        means = crown.gaussians.means.double().numpy()[crown.probability.numpy() > 0.5]
        apart = np.linalg.norm(means[:, None] - crown.truth.centers, axis=2) / (0.5 * crown.truth.diameters)
        return float(apart.min(axis=1).std())

    assert thickness(0.15) > 3.0 * thickness(0.0)


@pytest.mark.parametrize(
    ("method", "least"),
    [
        ("DBSCAN + mass ratio", 0.85),
        ("plain centre voting", 0.85),
        ("FruitNeRF's clustering", 0.85),
        ("paper's template road", 0.9),
        ("ours", 0.95),
    ],
)
def test_fruit_that_hang_apart_are_found(crown: Simulation, method: str, least: float):
    surface = surface_of(crown.gaussians, crown.probability, crown.cameras)
    assert count_metrics(*METHODS[method](crown, surface), crown.truth).f1 > least


def test_the_settings_are_those_of_the_first_experiment():
    assert list(SETTINGS) == [
        "sparse", "clumped", "mixed sizes", "heavy occlusion", "half ring", "drift between sides",
    ]  # fmt: skip
    assert all(200 <= setting.fruits[0] <= setting.fruits[1] <= 800 for setting in SETTINGS.values())
    assert all(24 <= setting.views <= 48 for setting in SETTINGS.values())


def test_the_table_says_where_no_other_method_was_better():
    trials = [Trial("sparse", s, m, f) for s, m, f in ((0, "a", 0.5), (0, "b", 0.9), (1, "a", 0.8), (1, "b", 0.8))]
    lines = counting_table(trials).splitlines()
    assert lines[2] == "| a | 0.650 | 1 of 2 |"
    assert lines[3] == "| b | 0.850 | 2 of 2 |"


def test_an_unknown_setting_is_one_line():
    command = [sys.executable, str(ROOT / "scripts" / "compare_counting.py"), "--settings", "easy"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: there is no setting 'easy'")


def test_how_much_of_a_fruit_is_visible_is_told_behind_leaves_as_in_front_of_them():
    crown = simulate(replace(FEW, fruits=(40, 40), leaves=5000, views=16, wrong=0.0), 6)
    counted = count_fruit(crown.gaussians, crown.probability, crown.cameras, CountConfig(), label="fruit")
    everything = replace(crown.truth, visible=np.ones(len(crown.truth.visible), bool))
    pairs = judge(counted.centers, counted.diameters, everything).pairs
    told = np.array([counted.fruits[index].visible_fraction for index in pairs.predicted], float)
    true = crown.truth.visible_fractions[pairs.true]
    assert len(pairs) > 15
    assert true.min() < 0.3
    assert np.corrcoef(told, true)[0, 1] > 0.9
    assert np.abs(told - true).mean() < 0.1


def test_fruit_that_three_views_show_are_fewer_than_those_of_which_one_shows_a_twentieth():
    crown = simulate(replace(FEW, fruits=(60, 60), leaves=6000, views=16), 7)
    assert 0 < crown.shown.sum() < crown.truth.visible.sum()
    assert not (crown.shown & ~crown.truth.visible).any()
