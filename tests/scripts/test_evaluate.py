"""Measuring a result folder: against the truth of what was counted, and of nothing else."""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.errors import FruitLangsError


def measured(folder: Path, prompts: list[str], *flags: str) -> None:
    """Run evaluate.py on two fruit counted by `prompts`, in a truth of an apple, a pear and a plum."""
    names, places = ("apple", "pear", "plum"), ([0, 0, 0], [1, 0, 0], [2, 0, 0])
    true = [
        {"label": name, "center": place, "diameter": 0.1, "visible": True, "visible_fraction": 1.0}
        for name, place in zip(names, places, strict=True)
    ]
    (folder / "truth.json").write_text(json.dumps({"fruits": true}))
    label = " or ".join(prompts)
    found = [{"id": k + 1, "label": label, "center": places[k], "diameter": 0.1} for k in range(2)]
    training = {"psnr": None, "ssim": None}
    provenance = {"source": "", "inputs_sha256": "", "encoder": "", "training": training, "prompts": prompts}
    document = {"schema": "fruitlangs.fruits/1", "set_id": "", "fruits": found, "config": {}, "files": {}}
    content = {**document, "metres_per_unit": None, "provenance": provenance}
    (folder / "fruits.json").write_text(json.dumps(content))
    evaluate(str(folder), "--truth", str(folder / "truth.json"), *flags)


def evaluate(*arguments: str) -> None:
    importlib.import_module("evaluate").main(arguments)


def visible(printed: str) -> str:
    """The number of visible true fruit in the table's first row."""
    return printed.splitlines()[1].split()[3]


@pytest.mark.parametrize(
    ("prompts", "true"), [(["apple", "pear"], "2"), (["red apple"], "1"), (["apples"], "1"), (["fruit"], "3")]
)
def test_a_count_is_measured_against_every_object_its_prompts_name(prompts, true, tmp_path, capsys) -> None:
    measured(tmp_path, prompts)
    assert visible(capsys.readouterr().out) == true


@pytest.mark.parametrize(("prompts", "said"), [(["red"], "names no fruit"), (["lemon"], "the truth has no lemon")])
def test_prompts_without_any_true_fruit_are_an_error(prompts, said, tmp_path) -> None:
    with pytest.raises(FruitLangsError, match=said):
        measured(tmp_path, prompts)


def test_a_label_goes_before_the_prompts(tmp_path, capsys) -> None:
    measured(tmp_path, ["red"], "--label", "plum")
    assert visible(capsys.readouterr().out) == "1"


def in_a_frame_of_its_own(folder: Path, cameras: int) -> None:
    """Count apple and pear of `measured` with cameras in a frame that is turned, doubled and moved."""
    measured(folder, ["apple", "pear"])
    turn, move = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 6.0, 7.0])
    views, listed = [], []
    for name, center in zip("abcd"[:cameras], ([3, 0, 0], [0, 3, 1], [-3, 0, 2], [0, -3, 0]), strict=False):
        lens = {"name": f"{name}.jpg", "width": 64, "height": 48}
        pose = np.eye(4)
        pose[:3, 3] = -np.array(center, dtype=np.float64)
        views.append({**lens, "focal": 50.0, "world_to_camera": pose.tolist()})
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn.T, -turn.T @ (2.0 * turn @ center + move)
        listed.append({**lens, "K": np.diag([50.0, 50.0, 1.0]).tolist(), "world_to_camera": pose.tolist()})
    truth = json.loads((folder / "truth.json").read_text())
    (folder / "truth.json").write_text(json.dumps({**truth, "views": views}))
    document = {"schema": "fruitlangs.cameras/1", "up": [0, 0, 1], "metres_per_unit": None, "cameras": listed}
    (folder / "cameras.json").write_text(json.dumps(document))
    content = json.loads((folder / "fruits.json").read_text())
    for fruit in content["fruits"]:
        fruit["center"] = (2.0 * turn @ fruit["center"] + move).tolist()
        fruit["diameter"] *= 2.0
    (folder / "fruits.json").write_text(json.dumps(content))


def test_a_result_in_a_frame_of_its_own_is_moved_to_the_truth_by_its_cameras(tmp_path, capsys) -> None:
    in_a_frame_of_its_own(tmp_path, cameras=4)
    capsys.readouterr()
    evaluate(str(tmp_path), "--truth", str(tmp_path / "truth.json"))
    printed = capsys.readouterr()
    assert printed.out.splitlines()[1].split()[2:5] == ["2", "2", "2"]  # predicted, visible, matched
    assert "moved to the truth by 4 cameras" in printed.err


def test_two_cameras_do_not_tell_how_to_move_a_result(tmp_path) -> None:
    in_a_frame_of_its_own(tmp_path, cameras=2)
    with pytest.raises(FruitLangsError, match="share 2 cameras"):
        evaluate(str(tmp_path), "--truth", str(tmp_path / "truth.json"))


def test_cameras_of_another_scene_are_an_error(tmp_path) -> None:
    in_a_frame_of_its_own(tmp_path, cameras=4)
    content = json.loads((tmp_path / "cameras.json").read_text())
    names = [camera["name"] for camera in content["cameras"]]
    for camera, name in zip(content["cameras"], [names[1], names[0], *names[2:]], strict=True):
        camera["name"] = name
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    with pytest.raises(FruitLangsError, match="more than a fruit's diameter off"):
        evaluate(str(tmp_path), "--truth", str(tmp_path / "truth.json"))


def test_a_damaged_result_is_named(tmp_path, capsys) -> None:
    measured(tmp_path, ["apple"])
    (tmp_path / "fruits.json").write_text('{"schema": "fruitlangs.fruits/1"}')
    with pytest.raises(FruitLangsError, match=r"fruits\.json"):
        evaluate(str(tmp_path), "--truth", str(tmp_path / "truth.json"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["somewhere"], "Give --out DIR"),
        (["somewhere", "--out", "a", "--truth", "b"], "and not both"),
        (["--truth", "truth.json"], "Nothing is given"),
    ],
)
def test_a_command_line_that_measures_nothing_is_an_error(arguments, said) -> None:
    with pytest.raises(FruitLangsError, match=said):
        evaluate(*arguments)
