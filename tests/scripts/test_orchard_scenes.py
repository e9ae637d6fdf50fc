"""Scenes that the generator renders: their files, their truth, how a run ends and goes on."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from orchard_runs import SCRIPT, TINY, make, needs_bpy, read_grey

from fruitlangs.engine.evaluation.datasets.fruitnerf import read_fruit_masks
from fruitlangs.engine.evaluation.trees import assign_to_trees, compare, places_of, tally
from fruitlangs.engine.evaluation.truth import read_truth


@pytest.mark.parametrize(("flags", "word"), [(("--seed", "-3"), "seed is -3"), (("--preview", "-1"), "preview is -1")])
def test_a_flag_below_its_least_value_is_one_line_and_leaves_no_folder(
    flags: tuple[str, ...], word: str, tmp_path: Path
) -> None:
    done = make(tmp_path / "scene", *flags)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert word in done.stderr
    assert not (tmp_path / "scene").exists()


def test_a_python_without_bpy_is_informed_how_to_install_it(tmp_path: Path) -> None:
    code = "import runpy, sys; sys.modules['bpy'] = None; del sys.argv[0]; runpy.run_path(sys.argv[0], {}, '__main__')"
    command = [sys.executable, "-c", code, str(SCRIPT), "--out", str(tmp_path / "scene")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "-m pip install bpy" in done.stderr


@needs_bpy
def test_an_out_that_is_a_file_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "scene").write_text("")
    done = make(tmp_path / "scene")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "Not a directory" in done.stderr


@needs_bpy
def test_a_damaged_mark_of_a_scene_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "orchard.json").write_text('{"digest": ')
    done = make(tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "orchard.json is damaged" in done.stderr


@needs_bpy
def test_an_interrupt_ends_with_130(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--out", str(tmp_path / "scene"), *TINY.split(), "--views", "500"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        while "view 1/" not in process.stderr.readline():
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=300)
    assert process.returncode == 130
    assert "Traceback" not in rest


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("orchard") / "scene"
    done = make(out, "--classes")
    assert done.returncode == 0, done.stderr
    return out


@needs_bpy
def test_a_scene_has_every_file(scene: Path) -> None:
    names = {p.relative_to(scene).as_posix() for p in scene.rglob("*") if p.is_file()}
    for stem in ("001", "002", "003"):
        assert {f"images/{stem}.jpg", f"instances/{stem}.png", f"classes/{stem}.png", f"depth/{stem}.png"} <= names
    assert {"truth.json", "classes.json", "orchard.json", "sparse/0/cameras.bin", "sparse/0/points3D.bin"} <= names
    assert not any(n.startswith("cache/") or n.endswith(".part") for n in names)


@needs_bpy
def test_truth_is_the_same_bytes_for_the_same_seed(scene: Path, tmp_path: Path) -> None:
    assert make(tmp_path / "again", "--classes").returncode == 0
    assert (tmp_path / "again" / "truth.json").read_bytes() == (scene / "truth.json").read_bytes()
    assert (tmp_path / "again" / "images" / "002.jpg").read_bytes() == (scene / "images" / "002.jpg").read_bytes()


@needs_bpy
@pytest.mark.skipif(sys.platform != "linux", reason="finds C's stdout as Linux names it")
def test_what_c_prints_while_quiet_is_lost_even_where_its_stdout_is_buffered(tmp_path: Path) -> None:
    code = (
        "import ctypes, sys; sys.path.insert(0, sys.argv[1])\n"
        "import _checkout; from fruitlangs.orchard.blender.render import silence\n"
        "libc = ctypes.CDLL(None); puts = libc.puts; held = ctypes.create_string_buffer(4096)\n"
        "libc.setvbuf(ctypes.c_void_p.in_dll(libc, 'stdout'), held, 0, 4096)  # bpy may have left it unbuffered\n"
        "puts(b'before')\nwith silence(): puts(b'while')\nputs(b'after'); libc.fflush(None)"
    )
    command = [sys.executable, "-c", code, str(SCRIPT.parent)]
    with (tmp_path / "log").open("w") as log:
        subprocess.run(command, stdout=log, timeout=300, check=True)
    assert (tmp_path / "log").read_text().split() == ["before", "after"]


@needs_bpy
def test_truth_counts_the_pixels_of_the_instance_masks(scene: Path) -> None:
    truth = json.loads((scene / "truth.json").read_text())
    for stem in ("001", "002", "003"):
        mask = read_grey(scene / "instances" / f"{stem}.png")
        for fruit in truth["fruits"]:
            assert fruit["visible_pixels"].get(f"{stem}.jpg", 0) == int((mask == fruit["id"]).sum())


@needs_bpy
def test_the_model_reads_and_reprojects_fruit_onto_their_masks(scene: Path) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert model.num_images() == 3
    fruits = json.loads((scene / "truth.json").read_text())["fruits"]
    hits = total = 0
    for image in model.images.values():
        mask = read_grey(scene / "instances" / f"{Path(image.name).stem}.png")
        for fruit in fruits:
            if fruit["visible_pixels"].get(image.name, 0) < 3:
                continue
            rows, columns = np.nonzero(mask == fruit["id"])
            x, y = image.project_point(np.array(fruit["center"]))
            depth = (image.cam_from_world() * np.array(fruit["center"]))[2]
            radius = 0.5 * fruit["diameter"] / depth * model.cameras[image.camera_id].focal_length_x
            hits += bool(np.hypot(columns + 0.5 - x, rows + 0.5 - y).max() < 1.25 * radius + 1.0)
            total += 1
    assert total > 5
    assert hits == total


@needs_bpy
def test_depth_is_in_millimetres_along_the_optical_axis_of_the_true_camera(scene: Path) -> None:
    truth = json.loads((scene / "truth.json").read_text())
    assert truth["metres_per_unit"] == 1.0
    assert [view["name"] for view in truth["views"]] == ["001.jpg", "002.jpg", "003.jpg"]
    checked = 0
    for view in truth["views"]:
        stem = Path(view["name"]).stem
        mask, depth = read_grey(scene / "instances" / f"{stem}.png"), read_grey(scene / "depth" / f"{stem}.png")
        pose = np.array(view["world_to_camera"])
        for fruit in truth["fruits"]:
            if (mask == fruit["id"]).any():
                away = (pose[:, :3] @ fruit["center"] + pose[:, 3])[2]
                front = depth[mask == fruit["id"]].min() / 1000
                assert away - fruit["diameter"] < front < away + 0.5 * fruit["diameter"]
                checked += 1
    assert checked > 5


@needs_bpy
def test_observations_reproject_within_a_few_pixels(scene: Path) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert model.num_points3D() > 50
    for image in model.images.values():
        for point in image.points2D:
            if point.has_point3D():
                seen = image.project_point(model.points3D[point.point3D_id].xyz)
                assert np.abs(seen - point.xy).max() < 0.5


@needs_bpy
def test_no_point_of_the_cloud_is_at_a_fruit_centre(scene: Path) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    points = np.array([p.xyz for p in model.points3D.values()])
    for fruit in json.loads((scene / "truth.json").read_text())["fruits"]:
        nearest = np.linalg.norm(points - fruit["center"], axis=1).min()
        assert nearest > 0.3 * fruit["diameter"]


@needs_bpy
def test_classes_agree_with_instances(scene: Path) -> None:
    words = json.loads((scene / "classes.json").read_text())
    fruit = next(int(i) for i, word in words.items() if word == "apple")
    for stem in ("001", "002", "003"):
        mask = read_grey(scene / "instances" / f"{stem}.png")
        classes = read_grey(scene / "classes" / f"{stem}.png")
        assert np.array_equal(mask > 0, classes == fruit)


@needs_bpy
def test_a_finished_scene_is_left_alone_and_other_settings_are_refused(scene: Path) -> None:
    before = (scene / "images" / "001.jpg").stat().st_mtime_ns
    again = make(scene, "--classes")
    assert again.returncode == 0
    assert "already complete" in again.stderr
    assert (scene / "images" / "001.jpg").stat().st_mtime_ns == before
    other = make(scene, "--seed", "9")
    assert other.returncode == 1
    assert "other settings" in other.stderr


@needs_bpy
def test_blur_and_drift_change_pictures_and_leave_masks_and_depth_sharp(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "drift"
    drift = ("--motion-blur", "6", "--exposure-drift", "0.5", "--white-balance-drift", "0.3")
    assert make(out, *drift, "--preview", "1").returncode == 0
    assert (out / "images" / "001.jpg").read_bytes() != (scene / "images" / "001.jpg").read_bytes()
    for name in ("instances/001.png", "depth/001.png"):
        assert (out / name).read_bytes() == (scene / name).read_bytes()


@needs_bpy
def test_wind_moves_what_is_seen_and_no_fruit(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "wind"
    assert make(out, "--leaf-motion", "60", "--preview", "1").returncode == 0
    assert (out / "depth" / "001.png").read_bytes() != (scene / "depth" / "001.png").read_bytes()
    before, after = (json.loads((each / "truth.json").read_text())["fruits"] for each in (scene, out))
    assert [f["center"] for f in before] == [f["center"] for f in after]


@pytest.fixture(scope="module")
def varied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A row of two vases with neighbours, everything that drifts, and FruitNeRF's layout."""
    out = tmp_path_factory.mktemp("orchard") / "varied"
    (out.parent / "row.toml").write_text(
        'form = "vase"\ntrees = 2\npath = "row"\nneighbours = 4\nfruit_pixels = 5\nfallen = 5\ntags = 3\nflowers = 4\n'
        "exposure_drift = 0.3\nwhite_balance_drift = 0.2\nmotion_blur = 2.0\nleaf_motion = 10.0\npose_noise = 1.0\n"
    )
    done = make(out, "--scene", str(out.parent / "row.toml"), "--fallen", "0", "--layout", "nerfstudio")
    assert done.returncode == 0, done.stderr
    return out


@needs_bpy
def test_a_scene_of_a_file_and_flags_keeps_the_settings_it_resolved_to(varied: Path) -> None:
    config = json.loads((varied / "orchard.json").read_text())["config"]
    assert (config["form"], config["trees"], config["fruits"], config["pose_noise"]) == ("vase", 2, 12, 1.0)


@needs_bpy
def test_fruit_of_a_row_give_their_tree_and_those_of_neighbours_are_never_visible(varied: Path) -> None:
    fruits = json.loads((varied / "truth.json").read_text())["fruits"]
    assert [f["id"] for f in fruits] == list(range(1, 73))
    assert [sum(f["tree"] == tree for f in fruits) for tree in (1, 2, 0)] == [12, 12, 48]
    assert {f["kind"] for f in fruits if f["tree"] == 0} == {"neighbour"}
    assert not any(f["visible"] for f in fruits if f["kind"] == "neighbour")


@needs_bpy
def test_neighbours_are_where_their_masks_are(varied: Path) -> None:
    truth = json.loads((varied / "truth.json").read_text())
    far = {f["id"]: f for f in truth["fruits"] if f["kind"] == "neighbour"}
    checked = 0
    for view in truth["views"]:
        mask = read_grey(varied / "instances" / f"{Path(view['name']).stem}.png")
        pose = np.array(view["world_to_camera"])
        for number in set(np.unique(mask).tolist()) & set(far):
            local = pose[:, :3] @ far[number]["center"] + pose[:, 3]
            middle = local[:2] / local[2] * view["focal"] + [view["width"] / 2, view["height"] / 2]
            rows, columns = np.nonzero(mask == number)
            assert np.hypot(columns + 0.5 - middle[0], rows + 0.5 - middle[1]).max() < 5
            checked += 1
    assert checked > 0


@needs_bpy
def test_written_poses_carry_noise_and_truth_undoes_it(varied: Path) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(varied / "sparse" / "0"))
    true = {v["name"]: np.array(v["world_to_camera"]) for v in json.loads((varied / "truth.json").read_text())["views"]}
    for image in model.images.values():
        written = image.cam_from_world().matrix()
        turn = written[:, :3] @ true[image.name][:, :3].T
        angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
        assert 0.1 < angle < 6.0


@needs_bpy
def test_the_nerfstudio_layout_has_masks_a_cloud_and_opengl_poses_of_the_same_cameras(varied: Path) -> None:
    import pycolmap

    model = pycolmap.Reconstruction(str(varied / "sparse" / "0"))
    poses = {image.name: image.cam_from_world().matrix() for image in model.images.values()}
    document = json.loads((varied / "transforms.json").read_text())
    assert (varied / document["ply_file_path"]).read_bytes().startswith(b"ply\n")
    for frame in document["frames"]:
        matrix = np.array(frame["transform_matrix"])
        in_front = matrix @ [0.0, 0.0, -2.0, 1.0]
        np.testing.assert_allclose(poses[Path(frame["file_path"]).name] @ in_front, [0.0, 0.0, 2.0], atol=1e-9)
        mask = read_grey(varied / frame["semantic_path"])
        ids = read_grey(varied / "instances" / Path(frame["semantic_path"]).name)
        assert np.array_equal(mask == 255, ids > 0)


@needs_bpy
def test_the_importer_of_fruitnerfs_layout_reads_what_the_generator_writes(varied: Path) -> None:
    masks = read_fruit_masks(varied / "transforms.json")
    assert len(masks) == 3
    for mask in masks:
        ids = read_grey(varied / "instances" / Path(mask.name).with_suffix(".png").name)
        assert np.array_equal(mask.pixels(), ids > 0)


@needs_bpy
def test_the_row_is_compared_tree_by_tree_and_neighbours_belong_to_none(varied: Path) -> None:
    truth = read_truth(varied / "truth.json")
    assert truth.trees is not None
    row = truth.trees > 0
    places = places_of(truth.centers, truth.trees)
    assert places.numbers.tolist() == [1, 2]
    compared = compare(
        tally(truth.trees, places.numbers), assign_to_trees(truth.centers[row], places, np.array([0.0, 0.0, 1.0]))
    )
    assert compared.true.tolist() == [12, 12]
    assert compared.counted.sum() >= 20


@needs_bpy
def test_a_killed_run_continues_to_the_same_bytes(varied: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    scene_file = str(varied.parent / "row.toml")
    assert make(out, "--scene", scene_file, "--fallen", "0", "--preview", "1").returncode == 0
    assert make(out, "--scene", scene_file, "--fallen", "0").returncode == 0
    for name in ("truth.json", "images/001.jpg", "images/002.jpg", "instances/003.png", "depth/003.png"):
        assert (out / name).read_bytes() == (varied / name).read_bytes()
