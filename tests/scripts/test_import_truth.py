"""Published layouts become a truth.json that evaluate.py and compare_trees.py measure against."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.errors import FruitLangsError
from fruitlangs.engine.evaluation.truth import read_truth
from fruitlangs.engine.scene.camera import ArrayPhoto, Camera, Scene
from fruitlangs.engine.scene.formats.cameras_json import dump_cameras

PLACES = np.array([[0.0, 0.0, 1.0], [0.1, 0.1, 1.2], [0.0, 1.0, 1.1], [0.1, 2.0, 1.0]])
TREES = [1, 1, 2, 3]
CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0


def run(script: str, *arguments: object) -> int:
    """The exit code of a script, whose error goes to stderr."""
    try:
        importlib.import_module(script).main([str(argument) for argument in arguments])
    except FruitLangsError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


@pytest.fixture
def row(tmp_path: Path) -> Path:
    """Four boxes of 8 cm on three trees, and a cloud of two points."""
    folder = tmp_path / "Fuji-SfM_dataset" / "3-3D_data"
    boxes = folder / "GroundTruth-3D_apples_locations" / "test_set"
    boxes.mkdir(parents=True)
    for number, (place, tree) in enumerate(zip(PLACES, TREES, strict=True)):
        rows = np.vstack([[place], place + 0.08 * CORNERS])
        np.savetxt(boxes / f"Tree{tree:02d}-annotations_{number:06d}.txt", rows)
    (folder / "Fuji_apple_trees_point_cloud.txt").write_text("0 0 1 200 20 10\n0.1 1 1.5 30 160 40\n")
    return folder.parent


def result(folder: Path, centers: np.ndarray) -> Path:
    """A result folder that counted apples of 8 cm at these places."""
    folder.mkdir(exist_ok=True)
    found = [
        {"id": k + 1, "label": "apple", "center": list(map(float, place)), "diameter": 0.08}
        for k, place in enumerate(centers)
    ]
    training = {"psnr": None, "ssim": None}
    provenance = {"source": "", "inputs_sha256": "", "encoder": "", "training": training, "prompts": ["apple"]}
    document = {"schema": "fruitlangs.fruits/1", "set_id": "", "fruits": found, "config": {}, "files": {}}
    content = {**document, "metres_per_unit": None, "provenance": provenance}
    (folder / "fruits.json").write_text(json.dumps(content))
    camera = Camera(K=np.eye(3), world_to_camera=np.eye(4), width=8, height=8)
    photo = ArrayPhoto("a.jpg", np.zeros((8, 8, 3), np.uint8))
    scene = Scene([camera], [photo], np.zeros((0, 3)), np.zeros((0, 3), np.uint8), up=np.array([0.0, 0.0, 1.0]))
    (folder / "cameras.json").write_text(dump_cameras(scene))
    return folder


def test_an_imported_row_is_measured_by_evaluate(row: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    truth = tmp_path / "truth.json"
    assert run("import_truth", "fuji-sfm", row, "--out", truth) == 0
    assert "by tree: 1: 2, 2: 1, 3: 1" in capsys.readouterr().out
    assert run("evaluate", result(tmp_path / "found", PLACES[:3]), "--truth", truth) == 0
    cells = capsys.readouterr().out.splitlines()[1].split()
    assert cells[1:9] == ["0.5", "3", "4", "3", "0", "1.000", "0.750", "0.857"]


def test_the_truth_has_every_field_of_a_generated_one(row: Path, tmp_path: Path) -> None:
    sample = json.loads((Path(__file__).resolve().parents[2] / "examples/orchard_tree/truth.json").read_text())
    run("import_truth", "fuji-sfm", row, "--out", tmp_path / "truth.json")
    written = json.loads((tmp_path / "truth.json").read_text())
    assert set(sample) <= set(written)
    assert set(sample["fruits"][0]) <= set(written["fruits"][0])
    assert [fruit["tree"] for fruit in written["fruits"]] == TREES
    assert all(fruit["visible"] and fruit["visible_fraction"] == 1.0 for fruit in written["fruits"])


def test_trees_of_an_imported_row_are_compared(row: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run("import_truth", "fuji-sfm", row, "--out", tmp_path / "truth.json")
    capsys.readouterr()
    found = result(tmp_path / "found", np.vstack([PLACES[1:], [[0.2, 1.9, 1.4], [0.0, 9.0, 1.0]]]))
    assert run("compare_trees", found, "--truth", tmp_path / "truth.json") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines[1:5]] == [
        ["1", "2", "2", "1", "-1", "0.667"],
        ["2", "1", "1", "1", "+0", "1.000"],
        ["3", "1", "1", "2", "+1", "0.667"],
        ["sum", "4", "4", "4", "+0"],
    ]
    assert lines[5] == "against visible fruit: MAPE 50.0%, bias +0.00 a tree, R² -2.000"
    assert lines[7] == "1 counted fruit belong to no tree of the row"


def test_a_result_that_names_its_trees_is_compared_by_them_whatever_their_order(
    row: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    run("import_truth", "fuji-sfm", row, "--out", tmp_path / "truth.json")
    capsys.readouterr()
    folder = result(tmp_path / "found", PLACES)
    document = json.loads((folder / "fruits.json").read_text())
    stand = [(number, PLACES[TREES.index(4 - number)].tolist()) for number in (1, 2, 3)]  # from the other end
    document["trees"] = [{"number": number, "position": place} for number, place in stand]
    for fruit, tree in zip(document["fruits"], (1, 1, 1, None), strict=True):
        fruit["tree"] = tree
    (folder / "fruits.json").write_text(json.dumps(document))
    assert run("compare_trees", folder, "--truth", tmp_path / "truth.json") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[3] for line in lines[1:4]] == ["0", "0", "3"]
    assert lines[7] == "1 counted fruit belong to no tree of the row"


def test_trees_may_be_boxes_of_a_table(row: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    run("import_truth", "fuji-sfm", row, "--out", tmp_path / "truth.json")
    (tmp_path / "boxes.txt").write_text("1 -1 -1 0 1 0.5 3\n2 -1 0.5 0 1 1.5 3\n")
    capsys.readouterr()
    found = result(tmp_path / "found", PLACES)
    assert run("compare_trees", found, "--truth", tmp_path / "truth.json", "--trees", tmp_path / "boxes.txt") == 0
    printed = capsys.readouterr().out
    assert [line.split()[3] for line in printed.splitlines()[1:4]] == ["2", "1", "0"]
    assert "1 counted fruit belong to no tree" in printed


def test_a_truth_without_trees_cannot_be_compared_by_tree(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    sample = Path(__file__).resolve().parents[2] / "examples/orchard_tree/truth.json"
    fruits = [
        {key: value for key, value in f.items() if key != "tree"} for f in json.loads(sample.read_text())["fruits"]
    ]
    (tmp_path / "truth.json").write_text(json.dumps({"fruits": fruits}))
    assert run("compare_trees", result(tmp_path / "found", PLACES), "--truth", tmp_path / "truth.json") == 1
    assert "none of its fruit says which tree" in capsys.readouterr().err


def test_a_similarity_moves_centres_and_scales_diameters(row: Path, tmp_path: Path) -> None:
    (tmp_path / "align.txt").write_text("0 -2 0 1\n2 0 0 0\n0 0 2 5\n0 0 0 1\n")
    truth = tmp_path / "truth.json"
    assert run("import_truth", "fuji-sfm", row, "--out", truth, "--transform", tmp_path / "align.txt") == 0
    moved = read_truth(truth)
    assert moved.centers[3] == pytest.approx([-2 * 2.0 + 1, 2 * 0.1, 2 * 1.0 + 5])
    assert moved.diameters == pytest.approx([0.16] * 4)
    assert json.loads(truth.read_text())["metres_per_unit"] == pytest.approx(0.5)


@pytest.mark.parametrize("matrix", ["1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "1 0 0 0\n0 2 0 0\n0 0 1 0\n0 0 0 1\n"])
def test_a_matrix_that_is_no_similarity_is_refused(
    matrix: str, row: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "align.txt").write_text(matrix)
    out = tmp_path / "truth.json"
    assert run("import_truth", "fuji-sfm", row, "--out", out, "--transform", tmp_path / "align.txt") == 1
    assert "mirrors or stretches" in capsys.readouterr().err
    assert not out.exists()


def test_the_cloud_is_a_coloured_ply(row: Path, tmp_path: Path) -> None:
    from plyfile import PlyData

    cloud = tmp_path / "row.ply"
    assert run("import_truth", "fuji-sfm", row, "--out", tmp_path / "truth.json", "--cloud", cloud) == 0
    vertices = PlyData.read(str(cloud))["vertex"]
    assert vertices["y"].tolist() == [0.0, 1.0]
    assert [int(vertices[channel][1]) for channel in ("red", "green", "blue")] == [30, 160, 40]


@pytest.mark.parametrize("layout", ["fuji-sfm", "pfuji-size", "fruitnerf"])
def test_an_empty_folder_is_one_line_that_names_it(layout: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("import_truth", layout, tmp_path, "--out", tmp_path / "truth.json") == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1
    assert str(tmp_path) in said
    assert "xpected" in said


def test_a_flag_of_another_layout_is_refused(row: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert run("import_truth", "fuji-sfm", row, "--out", tmp_path / "truth.json", "--part", "2018_01") == 1
    assert "--part is for pfuji-size" in capsys.readouterr().err


def test_equal_imports_are_equal_bytes(row: Path, tmp_path: Path) -> None:
    written = []
    for name in ("a.json", "b.json"):
        run("import_truth", "fuji-sfm", row, "--out", tmp_path / name)
        written.append((tmp_path / name).read_bytes())
    assert written[0] == written[1]
