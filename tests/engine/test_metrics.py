"""Counts measured on hand-made cases with known answers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.evaluation.metrics import count_metrics, match_centers
from fruitlangs.engine.evaluation.truth import Truth, read_truth

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
    with pytest.raises(FormatError, match="no true plum, only apple, pear"):
        read_truth(tmp_path / "truth.json", {"plum"})


def test_truth_with_a_centre_that_is_no_number_is_refused(tmp_path: Path) -> None:
    fruit = {"label": "apple", "center": [0, 0, float("nan")], "diameter": 1, "visible": True, "visible_fraction": 1}
    (tmp_path / "truth.json").write_text(json.dumps({"fruits": [fruit]}))
    with pytest.raises(FormatError, match="not a finite number"):
        read_truth(tmp_path / "truth.json")


def test_a_truth_without_a_field_names_the_field(tmp_path: Path) -> None:
    (tmp_path / "truth.json").write_text('{"fruits": [{"label": "apple", "center": [0, 0, 0]}]}')
    with pytest.raises(FormatError, match="diameter"):
        read_truth(tmp_path / "truth.json")
