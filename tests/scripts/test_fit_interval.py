"""Fitting how sure a count is."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import fit_interval
import numpy as np
import pytest

from fruitlangs.benchmarks.counting.simulated import SETTINGS, Setting, sample_setting, simulate
from fruitlangs.engine.counting.accounts.interval import COVARIATES, TRAINED, Evidence
from fruitlangs.engine.errors import ConfigError, FormatError
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.fitting.counting.cases import Case, find_shown
from fruitlangs.fitting.counting.examples import Example, merge_examples, read_examples, write_examples

ROOT = Path(__file__).resolve().parents[2]


def scene(seed: int, spread: float = 0.1, faint: float = 0.0) -> Example:
    """A scene whose fruit are 1.2 times what is expected where it is in doubt by 0.2, give or take `spread`."""
    rng = np.random.default_rng(seed)
    covariates = np.array([rng.uniform(0.0, 0.3), faint, 0.0])
    expected = float(rng.uniform(50.0, 500.0))
    number = expected * np.exp(covariates[0] * np.log(1.2) / 0.2 + rng.normal(0.0, spread))
    evidence = Evidence(expected, 0.0, covariates)
    return Example("drawn", f"crown {seed}", evidence, round(number), round(2 * number))


SCENES = [scene(seed) for seed in range(1000, 1040)]


def test_the_ratio_finds_what_gives_of_more_fruit_and_how_far_it_errs():
    ratio = fit_interval.fit_stretched(SCENES, fit_interval.TRUTHS["visible"])
    assert ratio.weights[0] == pytest.approx(np.log(1.2) / 0.2, abs=0.35)
    assert ratio.weights[1:] == pytest.approx(np.zeros(len(COVARIATES) - 1), abs=0.05)
    assert ratio.floor * ratio.stretches == pytest.approx([0.1, 0.1], rel=0.3)


def test_nine_tenths_of_scenes_lie_within_by_ratios_that_never_saw_them():
    truth = fit_interval.TRUTHS["total"]
    ratio, without = fit_interval.fit(SCENES, truth)
    assert set(without) == {example.family for example in SCENES}
    assert np.mean([fit_interval.holds(without[e.family], e, truth(e)) for e in SCENES]) >= 0.9
    unseen = [scene(seed) for seed in range(2000, 2200)]
    assert 0.82 < np.mean([fit_interval.holds(ratio, e, truth(e)) for e in unseen]) < 0.97


def strange(family: str, kind: str = "drawn") -> Example:
    """A scene with ten times the fruit that are expected."""
    evidence = Evidence(100.0, 0.0, np.array([0.1, 0.0, 0.0]))
    return Example(kind, family, evidence, 1000, 1000)


def test_a_tree_that_sets_the_stretch_is_not_covered_by_the_ratio_that_was_fitted_without_it():
    few, truth = SCENES[:12], fit_interval.TRUTHS["visible"]
    examples = [*few, strange("crown 1"), strange("crown 2")]
    ratio, without = fit_interval.fit(examples, truth)
    assert fit_interval.holds(ratio, examples[-1], 1000)
    assert not fit_interval.holds(without["crown 2"], examples[-1], 1000)
    assert (without["crown 2"].stretches < ratio.stretches).all()


def test_all_scenes_of_a_tree_are_left_out_together_of_fit_and_stretch():
    few, truth = SCENES[:8], fit_interval.TRUTHS["visible"]
    both = [strange("walk 1314"), strange("walk 1314", kind="walk, half of the photos")]
    _, without = fit_interval.fit([*few, *both], truth)
    alone = fit_interval.fit_stretched(few, truth)
    assert without["walk 1314"].document() == alone.document()


def test_the_gradient_of_the_loss_is_that_of_its_values():
    loss = fit_interval.Loss.of([*SCENES, scene(7, faint=0.1)], fit_interval.TRUTHS["visible"])
    x, step = np.array([0.1, 0.5, 0.2, 0.3, -2.0, 0.1, 0.4, 0.2]), 1e-6
    moved = [
        (loss.compute_with_gradient(x + e)[0] - loss.compute_with_gradient(x - e)[0]) / (2 * step)
        for e in step * np.eye(8)
    ]
    assert loss.compute_with_gradient(x)[1] == pytest.approx(np.array(moved), rel=1e-5, abs=1e-5)


def test_the_table_counts_a_tree_once_however_many_scenes_it_has():
    twice = [replace(each, kind=kind) for each in SCENES[:5] for kind in ("walk, encoder", "walk, half of the photos")]
    wide = fit_interval.Ratio(0.0, np.zeros(3), 9.0, np.zeros(3), np.ones(2))
    without = {name: dict.fromkeys((each.family for each in twice), wide) for name in fit_interval.TRUTHS}
    lines = fit_interval.table(twice, without).splitlines()
    assert [line.split("|")[1:5] for line in lines[2:]] == [
        [" walk, encoder ", " 5 ", " 5 ", " 1.00 (0.57–1.00) "],
        [" walk, half of the photos ", " 5 ", " 5 ", " 1.00 (0.57–1.00) "],
        [" all ", " 10 ", " 5 ", " 1.00 (0.57–1.00) "],
    ]


def test_examples_are_read_as_they_were_written_and_later_ones_replace_earlier_ones(tmp_path: Path):
    path = tmp_path / "examples.csv"
    first, other = scene(1003, faint=0.05), scene(1004)
    again = replace(first, visible=7, evidence=replace(first.evidence, photos=True, dissent=0.25))
    write_examples(merge_examples([first, other], [again]), path)
    read = read_examples(path)
    assert [(each.kind, each.family, each.visible) for each in read] == [
        ("drawn", "crown 1003", 7), ("drawn", "crown 1004", other.visible),
    ]  # fmt: skip
    evidence, given = read[0].evidence, again.evidence
    assert (evidence.photos, evidence.dissent, read[1].total) == (True, 0.25, other.total)
    assert (read[1].evidence.photos, read[1].evidence.dissent) == (False, 0.0)
    assert [evidence.expected, evidence.variance] == pytest.approx([given.expected, given.variance], rel=1e-6)
    assert evidence.covariates == pytest.approx(given.covariates, rel=1e-6)


def test_a_damaged_table_of_examples_is_refused(tmp_path: Path):
    path = tmp_path / "examples.csv"
    path.write_text("kind,family\ndrawn,crown 1\n")
    with pytest.raises(FormatError, match="Restore it from the repository"):
        read_examples(path)


def test_stored_examples_give_coverages_and_no_file_changes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path, out = tmp_path / "examples.csv", tmp_path / "interval.json"
    write_examples(SCENES[:12], path)
    before = path.read_bytes()
    fit_interval.main(fit_interval.Options(stored=True, examples=path, out=out))
    assert "| drawn | 12 | 12 |" in capsys.readouterr().out
    assert path.read_bytes() == before
    assert not out.exists()
    with pytest.raises(ConfigError, match="has no examples"):
        fit_interval.main(fit_interval.Options(stored=True, examples=tmp_path / "none.csv", out=out))


def test_trained_scenes_that_err_more_do_not_widen_the_intervals_of_others():
    truth = fit_interval.TRUTHS["visible"]
    trained = [scene(seed, spread=0.8, faint=TRAINED) for seed in range(1100, 1140)]
    ratio = fit_interval.fit_stretched([*SCENES, *trained], truth)
    unseen = [scene(seed) for seed in range(2000, 2200)]
    faint = [scene(seed, spread=0.8, faint=TRAINED) for seed in range(3000, 3200)]
    for scenes in (unseen, faint):
        assert 0.85 < np.mean([fit_interval.holds(ratio, e, truth(e)) for e in scenes]) < 0.985


def test_a_crown_becomes_an_example_with_fruit_that_views_show_and_all():
    crown = simulate(Setting(fruits=(25, 25), leaves=400, views=10), 1003)
    case = Case("few", "crown 1003", crown.gaussians, crown.probability, crown.cameras, crown.truth, crown.shown)
    (example,) = fit_interval.make_example(case)
    assert example.total == 25
    assert crown.shown.sum() <= example.visible <= 25
    assert example.evidence.expected == pytest.approx(example.visible, rel=0.2)


def test_settings_drawn_at_random_differ_and_span_the_named_ones():
    drawn = [sample_setting(seed) for seed in range(200)]
    assert drawn[0] == sample_setting(0) != drawn[1]
    for setting in SETTINGS.values():
        assert min(each.leaves for each in drawn) < setting.leaves <= max(each.leaves for each in drawn) * 1.1
        assert min(each.fruits[0] for each in drawn) < setting.fruits[0]
        assert max(each.clump for each in drawn) >= setting.clump


def test_seeds_of_tests_and_tables_are_refused(tmp_path: Path):
    command = [
        sys.executable,
        str(ROOT / "scripts" / "developer" / "fit_interval.py"),
        "--first",
        "3",
        "--out",
        str(tmp_path / "i"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("error: Seeds below 1000 are for tests and tables")
    assert not (tmp_path / "i").exists()


def test_a_fruit_is_visible_in_half_of_the_photos_if_three_of_these_show_enough(tmp_path: Path):
    photos = [f"{number}.jpg" for number in range(6)]
    shown = {1: [90, 5, 90, 5, 90, 5], 2: [90, 90, 90, 90, 0, 0], 3: [90, 0, 90, 0, 11, 0]}  # of 200 pixels
    fruits = [
        {
            "id": number, "label": "apple", "center": [0, 0, 0], "diameter": 1.0, "visible": True,
            "visible_pixels": dict(zip(photos, pixels, strict=True)), "visible_fraction": 0.45,
            "visible_fractions": {name: count / 200 for name, count in zip(photos, pixels, strict=True)},
        }
        for number, pixels in shown.items()
    ]  # fmt: skip
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({"fruits": fruits}))
    truth = read_truth(path)
    assert find_shown(path, truth, photos).tolist() == [True, True, False]
    assert find_shown(path, truth, photos[::2]).tolist() == [True, False, False]
