"""Counts measured on hand-made cases with known answers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.counting.geometry.matching import match_centers
from fruitlangs.engine.errors import CountingError, FormatError, VocabularyError
from fruitlangs.engine.evaluation.calibration import calibration_error, interval_coverage
from fruitlangs.engine.evaluation.judgement import judge
from fruitlangs.engine.evaluation.metrics import count_metrics, measure_by_visibility
from fruitlangs.engine.evaluation.summary import summarise
from fruitlangs.engine.evaluation.truth import Truth, read_truth, read_views, true_labels

ROW = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])


def truth_of(centers: np.ndarray, visible: list[bool] | None = None) -> Truth:
    count = len(centers)
    seen = np.ones(count, bool) if visible is None else np.array(visible)
    return Truth(np.asarray(centers, float).reshape(-1, 3), np.ones(count), seen, seen.astype(float))


def measure(predicted: object, truth: Truth, radius: float = 0.5, diameter: float = 1.0):
    centers = np.asarray(predicted, float).reshape(-1, 3)
    return count_metrics(centers, np.full(len(centers), diameter), truth, radius)


def test_a_perfect_count_has_f1_one() -> None:
    metrics = measure(ROW[::-1], truth_of(ROW))
    assert (metrics.f1, metrics.matched, metrics.doubles, metrics.merges, metrics.center_error) == (1, 3, 0, 0, 0)


def test_a_miss_and_a_far_false_one_do_not_cancel() -> None:
    metrics = measure([[0, 0, 0], [1, 0, 0], [9, 9, 9]], truth_of(ROW))
    assert metrics.count_error == 0
    assert metrics.precision == metrics.recall == pytest.approx(2 / 3)
    assert metrics.doubles == 0


def test_two_predictions_on_one_fruit_are_a_double() -> None:
    metrics = measure([*ROW.tolist(), [0.2, 0, 0]], truth_of(ROW))
    assert (metrics.matched, metrics.doubles, metrics.merges, metrics.count_error) == (3, 1, 0, 1)


def test_one_prediction_between_two_fruit_is_a_merge() -> None:
    metrics = measure([[0.45, 0, 0], [5, 0, 0]], truth_of(ROW), diameter=1.5)
    assert (metrics.matched, metrics.merges, metrics.doubles) == (2, 1, 0)


def test_a_fruit_far_from_every_prediction_is_missed_but_not_merged() -> None:
    metrics = measure(ROW[:2], truth_of(ROW))
    assert (metrics.recall, metrics.merges) == (pytest.approx(2 / 3), 0)


def test_a_prediction_on_a_fruit_that_is_not_visible_is_ignored() -> None:
    metrics = measure(ROW, truth_of(ROW, [True, True, False]))
    assert (metrics.ignored, metrics.precision, metrics.f1) == (1, 1.0, 1.0)


def test_a_hidden_fruit_excuses_one_prediction_only() -> None:
    metrics = measure([*ROW.tolist(), [5.1, 0, 0]], truth_of(ROW, [True, True, False]))
    assert (metrics.ignored, metrics.doubles, metrics.precision) == (1, 1, pytest.approx(2 / 3))


def test_a_hidden_fruit_does_not_take_a_visible_fruits_prediction() -> None:
    truth = truth_of(np.array([[0.0, 0, 0], [0.4, 0, 0]]), [True, False])
    metrics = measure([[0.4, 0, 0]], truth)
    assert (metrics.matched, metrics.ignored) == (1, 0)


def test_the_radius_is_in_mean_diameters_of_visible_fruit() -> None:
    truth = Truth(ROW * 4, np.full(3, 4.0), np.ones(3, bool), np.ones(3))
    assert measure(ROW * 4 + [1.9, 0, 0], truth).matched == 3
    assert measure(ROW * 4 + [0, 2.1, 0], truth).matched == 0
    assert measure(ROW * 4 + [0, 2.1, 0], truth, radius=1.0).matched == 3


def test_matching_prefers_more_pairs_over_shorter_ones() -> None:
    matching = match_centers(np.array([[0.0, 0, 0], [0.9, 0, 0]]), np.array([[0.8, 0, 0], [1.7, 0, 0]]), 1.0)
    assert len(matching.true) == 2


def test_diameter_error_and_bias_are_relative_to_the_true_diameter() -> None:
    metrics = measure(ROW, truth_of(ROW), diameter=1.1)
    assert metrics.diameter_error == metrics.diameter_bias == pytest.approx(0.1)


def test_nothing_predicted_has_recall_zero_and_no_precision() -> None:
    metrics = measure([], truth_of(ROW))
    assert (metrics.recall, metrics.f1) == (0.0, 0.0)
    assert np.isnan(metrics.precision)


def test_nothing_predicted_where_nothing_is_has_f1_one() -> None:
    assert measure([], truth_of(np.zeros((0, 3)))).f1 == 1.0


def test_truth_is_read_by_label(tmp_path: Path) -> None:
    fruits = [
        {"label": label, "center": [0, 0, 1], "diameter": 0.1, "visible": True, "visible_fraction": 0.5}
        for label in ("apple", "pear")
    ]
    (tmp_path / "truth.json").write_text(json.dumps({"fruits": fruits}))
    assert len(read_truth(tmp_path / "truth.json", {"pear", "plum"}).centers) == 1
    assert len(read_truth(tmp_path / "truth.json").centers) == 2
    with pytest.raises(FormatError, match="the truth has no plum, only apple, pear"):
        read_truth(tmp_path / "truth.json", {"plum"})


@pytest.mark.parametrize(
    ("prompts", "labels"),
    [(["Red Apples"], {"apple"}), (["citrus", "pomme"], {"lemon", "orange", "apple"}),
     (["cherry plum"], {"cherry plum"}), (["fig"], {"fig"}), (["Ripe red Fig", "apple"], {"fig", "apple"}),
     (["the dragon-fruit"], {"dragon fruit"})],
)  # fmt: skip
def test_a_word_that_is_not_built_in_is_its_own_label(prompts: list[str], labels: set[str]) -> None:
    assert true_labels(prompts) == labels


@pytest.mark.parametrize(("prompt", "label"), [("figs", "fig"), ("green cherry tomatoes", "cherry tomato")])
def test_a_taught_word_in_the_plural_has_its_label_in_the_singular(prompt: str, label: str) -> None:
    assert label in true_labels([prompt])


@pytest.mark.parametrize("prompt", ["", "red", "the"])
def test_a_prompt_that_names_no_fruit_has_no_label(prompt: str) -> None:
    with pytest.raises(VocabularyError, match="names no fruit to measure against"):
        true_labels([prompt])


def test_truth_with_a_centre_that_is_no_number_is_refused(tmp_path: Path) -> None:
    fruit = {"label": "apple", "center": [0, 0, float("nan")], "diameter": 1, "visible": True, "visible_fraction": 1}
    (tmp_path / "truth.json").write_text(json.dumps({"fruits": [fruit]}))
    with pytest.raises(FormatError, match="not a finite number"):
        read_truth(tmp_path / "truth.json")


def test_a_truth_without_a_field_names_the_field(tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text('{"fruits": [{"label": "apple", "center": [0, 0, 0]}]}')
    with pytest.raises(FormatError, match="diameter"):
        read_truth(tmp_path / "truth.json")


def test_visible_and_total_truth_are_distinguished() -> None:
    metrics = measure(ROW[:2], truth_of(ROW, [True, True, False]))
    assert (metrics.visible, metrics.total) == (2, 3)
    assert (metrics.relative_count_error, metrics.relative_total_error) == (0.0, pytest.approx(-1 / 3))


def test_a_judgement_names_every_prediction_and_every_visible_fruit_once() -> None:
    truth = truth_of([[0, 0, 0], [0.6, 0, 0], [5, 0, 0], [8, 0, 0], [20, 0, 0]], [True, True, True, True, False])
    centers = np.array([[0.1, 0, 0], [5, 0, 0], [5.2, 0, 0], [50, 0, 0], [20.1, 0, 0]])
    judgement = judge(centers, np.full(5, 1.4), truth)
    assert judgement.pairs.predicted.tolist() == [0, 1]
    assert judgement.pairs.true.tolist() == [0, 2]
    assert judgement.doubles.tolist() == [2]
    assert judgement.false.tolist() == [3]
    assert judgement.ignored.tolist() == [4]
    assert judgement.merged.tolist() == [1]
    assert judgement.missed.tolist() == [3]


def test_errors_are_reported_by_visible_fraction() -> None:
    truth = Truth(ROW, np.ones(3), np.ones(3, bool), np.array([0.15, 0.3, 1.0]))
    judgement = judge(ROW[1:] + [0.1, 0, 0], np.array([1.2, 1.0]), truth)
    little, some, most = (measure_by_visibility(judgement, truth, (0.1, 0.25, 0.5, 1.0))[k] for k in range(3))
    assert (little.visible, little.recall, np.isnan(little.center_error)) == (1, 0.0, True)
    assert (some.recall, some.center_error, some.diameter_error) == (1.0, pytest.approx(0.1), pytest.approx(0.2))
    assert (most.visible, most.diameter_error) == (1, 0.0)


@pytest.mark.parametrize("broken", [float("nan"), float("inf")])
def test_a_prediction_without_a_finite_place_is_an_error(broken: float) -> None:
    with pytest.raises(CountingError, match="1 of 3 predictions"):
        measure([[0, 0, 0], [1, 0, 0], [broken, 0, 0]], truth_of(ROW))


@pytest.mark.parametrize(("field", "value", "said"), [("diameter", 0, "not above 0"), ("id", 1, "the same id")])
def test_a_truth_that_contradicts_itself_is_refused(field, value, said, tmp_path: Path) -> None:
    first = {"id": 1, "label": "apple", "center": [0, 0, 0], "diameter": 1, "visible": True, "visible_fraction": 1}
    second = {**first, "id": 2, field: value}
    (tmp_path / "truth.json").write_text(json.dumps({"fruits": [first, second]}))
    with pytest.raises(FormatError, match=said):
        read_truth(tmp_path / "truth.json")


def test_views_of_a_truth_are_read_and_may_be_missing(tmp_path: Path) -> None:
    pose = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 1, 7]]
    (tmp_path / "truth.json").write_text(json.dumps({"fruits": [], "views": [{"name": "a", "world_to_camera": pose}]}))
    assert read_views(tmp_path / "truth.json")[0].world_to_camera[:3, 3].tolist() == [5, 6, 7]
    (tmp_path / "truth.json").write_text('{"fruits": []}')
    assert read_views(tmp_path / "truth.json") == []


def test_probabilities_that_come_true_as_often_as_they_say_have_no_calibration_error() -> None:
    probabilities = np.repeat([0.2, 0.8], 50)
    outcomes = np.concatenate([np.arange(50) < 10, np.arange(50) < 40])
    assert calibration_error(probabilities, outcomes) == pytest.approx(0.0)
    assert calibration_error(probabilities, outcomes[::-1]) == pytest.approx(0.6)


def test_balanced_calibration_weighs_a_rare_outcome_as_much_as_a_common_one() -> None:
    outcomes = np.arange(100) < 10
    assert calibration_error(np.full(100, 0.1), outcomes) == pytest.approx(0.0)
    assert calibration_error(np.full(100, 0.1), outcomes, balanced=True) == pytest.approx(0.4)


def test_calibration_does_not_depend_on_the_order_of_equal_probabilities() -> None:
    probabilities, outcomes = np.round(np.linspace(0, 1, 200), 1), np.arange(200) % 3 == 0
    shuffled = np.random.default_rng(0).permutation(200)
    found = calibration_error(probabilities[shuffled], outcomes[shuffled])
    assert calibration_error(probabilities, outcomes) == pytest.approx(found)


def test_a_probability_out_of_range_is_an_error() -> None:
    with pytest.raises(CountingError, match="from 0 to 1"):
        calibration_error(np.array([0.5, np.nan]), np.array([True, False]))


def test_coverage_is_the_share_of_intervals_that_hold_the_truth() -> None:
    assert interval_coverage(np.array([1, 5, 5]), np.array([3, 6, 9]), np.array([3, 4, 7])) == pytest.approx(2 / 3)


def test_over_scenes_bias_cancels_and_mape_does_not() -> None:
    two_of_three, four_of_three = measure(ROW[:2], truth_of(ROW)), measure([*ROW, [1.1, 0, 0]], truth_of(ROW))
    summary = summarise([two_of_three, four_of_three])
    assert (summary.scenes, summary.bias, summary.mape) == (2, pytest.approx(0.0), pytest.approx(1 / 3))
    assert summary.f1 == pytest.approx((two_of_three.f1 + four_of_three.f1) / 2)
