"""Simulated crowns are what their settings say, and methods are compared on the same ones."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import ball_scene
import compare_counting
import numpy as np
import pytest

from fruitlangs.benchmarks.counting.baselines import METHODS, NONE, Found, Surface, count_by_default, surface_of
from fruitlangs.benchmarks.counting.crowns import make_scene_crown
from fruitlangs.benchmarks.counting.pages import counting_table, figures_table, visibility_table
from fruitlangs.benchmarks.counting.simulated import AXES, SETTINGS, Setting, Simulation, simulate
from fruitlangs.benchmarks.counting.touching import Touching, count_separated
from fruitlangs.benchmarks.counting.trials import Trial, measure_trial, read_trials, trials_csv
from fruitlangs.benchmarks.ladder.stages import COUNTING_ONLY, TRUE_MASKS, LadderStages
from fruitlangs.engine.config import Config, CountConfig
from fruitlangs.engine.counting.count import count_fruit
from fruitlangs.engine.errors import ConfigError, FormatError
from fruitlangs.engine.evaluation.judgement import judge
from fruitlangs.engine.evaluation.metrics import count_metrics
from fruitlangs.engine.evaluation.truth import Truth, read_truth
from fruitlangs.engine.progress import silent

ROOT = Path(__file__).resolve().parents[2]

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


def test_scenes_need_a_folder_for_what_is_trained():
    with pytest.raises(ConfigError, match="--scenes needs --out"):
        compare_counting.main(compare_counting.Options(scenes=("apple-small:101",)))


def test_ours_on_a_scene_counts_what_its_ablation_stage_counts(tmp_path: Path):
    scene, config = ball_scene.write_scene(tmp_path / "balls", views=10), Config()
    crown = make_scene_crown(scene, tmp_path / "out", COUNTING_ONLY, config)
    truth = read_truth(scene / "truth.json")
    stage = LadderStages(scene, tmp_path / "out", truth, [], ["apple"], config).run(COUNTING_ONLY, silent)
    assert (crown.setting, crown.seed) == ("apple", 7)
    assert crown.key != make_scene_crown(scene, tmp_path / "out", TRUE_MASKS, config).key
    assert crown.count({"ours": count_by_default})[0].metrics == count_metrics(stage.centers, stage.diameters, truth)


@pytest.mark.parametrize(
    ("method", "least"),
    [
        ("DBSCAN + mass ratio", 0.85),
        ("plain centre voting", 0.85),
        ("FruitNeRF's clustering", 0.85),
        ("paper's template method", 0.9),
        ("ours", 0.95),
    ],
)
def test_fruit_that_hang_apart_are_found(crown: Simulation, method: str, least: float):
    surface = surface_of(crown.gaussians, crown.probability, crown.cameras)
    assert count_metrics(*METHODS[method](surface), crown.truth).f1 > least


def test_the_settings_are_those_of_the_first_experiment():
    assert list(SETTINGS) == [
        "sparse", "clumped", "mixed sizes", "heavy occlusion", "half ring", "drift between sides",
    ]  # fmt: skip
    assert all(200 <= setting.fruits[0] <= setting.fruits[1] <= 800 for setting in SETTINGS.values())
    assert all(24 <= setting.views <= 48 for setting in SETTINGS.values())


def _trial(seed: int, method: str, **figures: float) -> Trial:
    """Nothing found of ten fruit, with other `figures`."""
    truth = Truth(
        centers=np.arange(30.0).reshape(10, 3),
        diameters=np.ones(10),
        visible=np.ones(10, bool),
        visible_fractions=np.linspace(0.1, 1.0, 10),
    )
    trial = measure_trial("sparse", seed, method, "key", NONE, truth)
    return replace(trial, metrics=replace(trial.metrics, **figures))


def test_the_table_says_where_no_other_method_was_better():
    trials = [_trial(s, m, f1=f) for s, m, f in ((0, "a", 0.5), (0, "b", 0.9), (1, "a", 0.8), (1, "b", 0.8))]
    lines = counting_table(trials).splitlines()
    assert lines[2] == "| a | 0.650 | 1 of 2 |"
    assert lines[3] == "| b | 0.850 | 2 of 2 |"


def test_figures_are_means_over_crowns_and_missing_ones_are_a_dash():
    trials = [_trial(0, "a", doubles=1, precision=0.5), _trial(1, "a", doubles=2, precision=1.0)]
    assert figures_table(trials).splitlines()[2] == "| a | 0.750 | 0.000 | 0.000 | 15.0 | 0.0 | 100.0% | – | – |"
    assert figures_table(trials, by_setting=True).splitlines()[2].startswith("| sparse, a | 0.750 |")


def test_what_a_class_of_visibility_has_is_reported_over_all_fruit():
    few, many = (_trial(seed, "a") for seed in (0, 1))
    few = replace(few, classes=(replace(few.classes[0], visible=1, recall=1.0, center_error=0.1, diameter_error=0.1),))
    many = replace(many, classes=(replace(few.classes[0], visible=9, recall=1.0, center_error=0.2),))
    lines = visibility_table([few, many]).splitlines()
    assert lines[2] == "| a | 1.000, 0.190, 10.0% |"
    assert lines[3] == "| fruit | 10 |"


def test_a_pair_is_distinguished_where_each_fruit_is_counted_once():
    truth = Truth(
        centers=np.array([[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0], [9.0, 0, 0], [10.0, 0, 0]]),
        diameters=np.ones(5),
        visible=np.ones(5, bool),
        visible_fractions=np.array([0.6, 0.55, 0.6, 0.6, 0.9]),
    )

    def apart(*places: float) -> Touching:
        return count_separated(np.array([[x, 0.0, 0.0] for x in places]).reshape(-1, 3), truth)

    assert apart() == Touching(1, 0)  # the third has no neighbour, and the last is seen too well
    assert apart(0.1, 1.1) == Touching(1, 1)
    assert apart(0.5) == Touching(1, 0)
    assert apart(0.1, 1.1, 1.4) == Touching(1, 0)  # one is counted twice
    assert apart(0.1, 1.1, -0.7) == Touching(1, 0)  # what is left over lies next to it
    assert apart(0.1, 1.1, 5.0, -3.0) == Touching(1, 1)
    assert apart(0.1, 1.7) == Touching(1, 0)


def test_trials_come_back_as_they_were_written(tmp_path: Path, crown: Simulation):
    found = crown.truth.centers[:9] + 0.1, crown.truth.diameters[:9]
    trials = [
        measure_trial("few", 3, "some", "key", found, crown.truth),
        measure_trial("few", 3, "none", "key", NONE, crown.truth),
    ]
    assert read_trials(tmp_path / "trials.csv") == []
    (tmp_path / "trials.csv").write_text(trials_csv(trials))
    assert trials_csv(read_trials(tmp_path / "trials.csv")) == trials_csv(trials)
    assert read_trials(tmp_path / "trials.csv")[0].metrics == trials[0].metrics
    (tmp_path / "trials.csv").write_text("setting,seed\nsparse,0\n")
    with pytest.raises(FormatError, match="Move it away"):
        read_trials(tmp_path / "trials.csv")


def test_a_second_run_goes_on_with_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    counted = list[str]()

    def counting(name: str, surface: Surface) -> Found:
        counted.append(name)
        return NONE

    monkeypatch.setitem(compare_counting.SETTINGS, "few", FEW)
    monkeypatch.setattr(compare_counting, "METHODS", {name: partial(counting, name) for name in ("a", "b")})
    options = compare_counting.Options(seeds=1, settings=("few",), out=tmp_path)
    compare_counting.main(options)
    first = (tmp_path / "counting.md").read_text()
    compare_counting.main(options)
    assert counted == ["a", "b"]
    assert (tmp_path / "counting.md").read_text() == first
    compare_counting.main(replace(options, seeds=2))
    assert counted == ["a", "b"] * 2
    monkeypatch.setitem(compare_counting.SETTINGS, "few", replace(FEW, leaves=50))
    compare_counting.main(options)
    assert counted == ["a", "b"] * 3
    compare_counting.main(replace(options, first=5, methods=("b",)))
    assert counted == ["a", "b"] * 3 + ["b"]
    assert "| a |" not in (tmp_path / "counting.md").read_text()
    with pytest.raises(ConfigError, match=r"Unknown method 'c'. Use one of a, b"):
        compare_counting.main(replace(options, methods=("c",)))


def test_along_an_axis_one_object_changes():
    for levels in AXES.values():
        first = next(iter(levels.values()))
        for setting in levels.values():
            changed = {name for name, value in vars(setting).items() if value != getattr(first, name)}
            assert changed <= {"least_clump", "clump"} or changed <= {"size_cv"}
    assert all(setting.least_clump == setting.clump for setting in AXES["clump"].values())


def test_clumps_of_one_size_touch():
    centers = simulate(replace(FEW, fruits=(24, 24), least_clump=4, clump=4), 8).truth.centers.reshape(6, 4, 3)
    nearest = np.linalg.norm(centers[:, :, None] - centers[:, None], axis=3) + 9.0 * np.eye(4)
    assert nearest.min(axis=2).max() < 1.5


def test_an_unknown_setting_is_one_line():
    command = [sys.executable, str(ROOT / "scripts" / "developer" / "compare_counting.py"), "--settings", "easy"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: Unknown setting 'easy'")


def test_how_much_of_a_fruit_is_visible_is_reported_behind_leaves_as_in_front_of_them():
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
