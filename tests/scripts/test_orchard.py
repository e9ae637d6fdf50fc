"""The synthetic orchard: its bodies, its truth, its sparse cloud, and a tiny rendered scene."""

from __future__ import annotations

import importlib.util
import json
import signal
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fruitlangs.engine.evaluation.fruitnerf import read_fruit_masks
from fruitlangs.engine.evaluation.trees import assign_to_trees, compare, places_of, tally
from fruitlangs.engine.evaluation.truth import read_truth
from orchard.body import Body, gap, signed_distance, smooth_profile, surface_points
from orchard.branch import wood_samples
from orchard.check import check
from orchard.config import FIRST_TRAINING_SEED, OrchardConfig
from orchard.crop import PlacedFruit
from orchard.errors import OrchardError
from orchard.fruiting import Fruiting
from orchard.meshes import Mesh
from orchard.planting import plant
from orchard.png import read_grey as png_read_grey
from orchard.png import write_grey
from orchard.sparse import sample_cloud
from orchard.species import SPECIES
from orchard.training import training_config
from orchard.tree import grow
from orchard.truth import Visibility, fruit_record, silhouette_pixels, visibilities
from orchard.viewpoint import Viewpoint, look_at

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "make_orchard.py"
TINY = "--fruits 12 --fallen 1 --leaves 200 --views 3 --rings 1 --width 64 --height 48 --samples 1 --points 300"
HAS_BPY = importlib.util.find_spec("bpy") is not None
needs_bpy = pytest.mark.skipif(not HAS_BPY, reason="the bpy module is not installed")


def make(out: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    """Run the script in a process of its own: Blender's module and pytest end apart."""
    command = [sys.executable, str(SCRIPT), "--out", str(out), *TINY.split(), *flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def read_grey(path: Path) -> np.ndarray:
    """The values of a PNG that `write_grey` wrote, by the specification rather than by our own code."""
    data = path.read_bytes()
    width, height, depth = struct.unpack(">IIB", data[16:25])
    start = data.index(b"IDAT")
    (length,) = struct.unpack(">I", data[start - 4 : start])
    raw = zlib.decompress(data[start + 4 : start + 4 + length])
    rows = np.frombuffer(raw, dtype=np.uint8).reshape(height, 1 + width * depth // 8)[:, 1:]
    return rows.copy().view(">u2" if depth == 16 else "u1").reshape(height, width)


def front_view(width: int = 40, height: int = 30) -> Viewpoint:
    """A camera at (0, -2, 0) that looks along +y; a pixel spans 0.05 m at distance 2."""
    pose = look_at(np.array([0.0, -2.0, 0.0]), np.zeros(3))
    return Viewpoint(name="001.jpg", focal=40.0, width=width, height=height, world_to_camera=pose)


def square(half: float) -> Mesh:
    """A box around the origin, `half` wide to each side, as a closed mesh."""
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    return Mesh(vertices=corners, quads=quads)


def ball(center: tuple[float, float, float], radius: float) -> Body:
    """A sphere as a body of revolution."""
    turn = np.linspace(0.0, np.pi, 60)
    profile = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return Body(center=np.array(center), axis=np.array([0.0, 0.0, 1.0]), profile=profile)


def test_signed_distance_to_a_ball_is_distance_to_its_centre_less_its_radius() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    expected = np.linalg.norm(points - [0.1, 0.2, 0.3], axis=1) - 0.5
    np.testing.assert_allclose(signed_distance(ball((0.1, 0.2, 0.3), 0.5), points), expected, atol=1e-3)


def test_gap_between_balls_is_negative_when_they_overlap() -> None:
    assert gap(ball((0, 0, 0), 0.5), ball((0.9, 0, 0), 0.5)) == pytest.approx(-0.1, abs=5e-3)
    assert gap(ball((0, 0, 0), 0.5), ball((1.2, 0, 0), 0.5)) == pytest.approx(0.2, abs=5e-3)


@pytest.mark.parametrize("name", list(SPECIES))
def test_a_species_profile_has_the_volume_of_a_unit_sphere(name: str) -> None:
    profile = smooth_profile(SPECIES[name].profile, 400)
    height, area = profile[:, 0], np.pi * profile[:, 1] ** 2
    volume = float((-np.diff(height) * (area[1:] + area[:-1]) / 2).sum())
    assert volume == pytest.approx(np.pi / 6, rel=2e-3)


@pytest.mark.parametrize("name", ["apple", "pear", "cherry"])
def test_fruit_touch_in_clumps_and_never_run_into_each_other(name: str) -> None:
    orchard = plant(OrchardConfig(species=name, seed=3, fruits=30, leaves=50))
    bodies = [f.body for f in orchard.fruits]
    mean = float(np.mean([f.diameter for f in orchard.fruits]))
    gaps = np.array([[gap(a, b) for b in bodies[:i]] + [np.inf] * (31 + 4 - i) for i, a in enumerate(bodies)])
    assert gaps.min() >= -0.02 * mean
    touching = int((gaps < 0.01 * mean).sum())
    clumps = np.bincount([f.clump for f in orchard.fruits if f.clump])
    assert touching >= int(np.maximum(clumps - 1, 0).sum()) > 0


def test_fruit_stay_out_of_the_wood() -> None:
    orchard = plant(OrchardConfig(seed=4, fruits=40, leaves=50))
    wood = wood_samples(orchard.branches)
    for fruit in orchard.fruits:
        assert (signed_distance(fruit.body, wood[:, :3]) - wood[:, 3]).min() >= 0.0


def test_surface_points_lie_on_the_body() -> None:
    body = plant(OrchardConfig(seed=1, fruits=1, fallen=0, leaves=1)).fruits[0].body
    assert np.abs(signed_distance(body, surface_points(body))).max() < 1e-9


def test_all_faces_of_a_fruit_look_outward() -> None:
    (mesh,) = plant(OrchardConfig(seed=1, fruits=1, fallen=0, leaves=1)).fruit_meshes
    triangles = mesh.triangles
    edges = {(int(a), int(b)) for t in triangles for a, b in zip(t, np.roll(t, -1), strict=True)}
    assert len(edges) == 3 * len(triangles)  # each is walked once this way …
    assert all((b, a) in edges for a, b in edges)  # … and once back, so neighbours agree
    a, b, c = mesh.vertices[triangles.T]
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).sum() > 0


def test_the_same_seed_plants_the_same_orchard_and_another_seed_another() -> None:
    config = OrchardConfig(seed=5, fruits=10, leaves=100)
    centers = [np.array([f.body.center for f in plant(c).fruits]) for c in (config, config, replace(config, seed=6))]
    assert np.array_equal(centers[0], centers[1])
    assert not np.array_equal(centers[0], centers[2])


def test_silhouette_of_a_box_covers_the_pixel_centres_inside_it() -> None:
    # The near face, 0.5 to each side at distance 1.5, spans ±13.33 pixels: 26 centres each way.
    assert silhouette_pixels(front_view(), square(0.5)) == 26 * 26


def test_silhouette_is_cut_at_the_picture() -> None:
    assert silhouette_pixels(front_view(width=10, height=30), square(0.5)) == 10 * 26


def test_visible_needs_three_views_with_enough_share_and_pixels() -> None:
    enough = Visibility(visible_pixels=(12, 12, 12), whole_pixels=(120, 120, 120))
    too_few_views = Visibility(visible_pixels=(12, 12, 11), whole_pixels=(100, 100, 100))
    too_small_a_share = Visibility(visible_pixels=(12, 12, 12), whole_pixels=(120, 120, 121))
    assert (enough.visible, too_few_views.visible, too_small_a_share.visible) == (True, False, False)


def test_visible_fraction_is_the_largest_share_over_views() -> None:
    shown = Visibility(visible_pixels=(10, 30, 0), whole_pixels=(100, 60, 0))
    assert shown.visible_fraction == pytest.approx(0.5)


def test_visibilities_count_the_mask_of_each_fruit() -> None:
    mask = np.zeros((30, 40), dtype=np.uint16)
    mask[2:5, 3:10] = 2
    (shown,) = visibilities([front_view()], [mask], [2], [square(0.5)])
    assert shown.visible_pixels == (21,)
    assert shown.whole_pixels == (676,)


def test_truth_names_the_share_that_each_view_shows_and_never_calls_a_neighbour_visible() -> None:
    shown = Visibility(visible_pixels=(12, 0, 30, 60), whole_pixels=(60, 0, 60, 60))
    body = ball((0, 0, 0), 0.04)
    fruit = PlacedFruit(id=1, body=body, diameter=0.08, kind="hanging", anchor=None, clump=1, tree=2)
    record = fruit_record(fruit, "apple", shown, ["a", "b", "c", "d"])
    assert record["visible_fractions"] == {"a": 0.2, "c": 0.5, "d": 1.0}
    assert (record["visible"], record["tree"]) == (True, 2)
    assert fruit_record(replace(fruit, kind="neighbour"), "apple", shown, ["a", "b", "c", "d"])["visible"] is False


def test_the_sparse_cloud_lies_on_what_is_seen_and_not_at_fruit_centres() -> None:
    # Two cameras see a wall at y = 0; a fruit's centre 0.04 behind the surface must not show up.
    views = [front_view(), replace(front_view(), name="002.jpg")]
    depths = [np.full((30, 40), 2.0, dtype=np.float32)] * 2
    pictures = [np.full((30, 40, 3), 99, dtype=np.uint8)] * 2
    cloud = sample_cloud(np.random.default_rng(0), views, depths, pictures, 400)
    assert len(cloud.points) == 400
    assert np.abs(cloud.points[:, 1]).max() < 0.015
    assert all(track == (0, 1) for track in cloud.tracks)
    assert (cloud.colors == 99).all()


def test_our_reader_reads_what_our_writer_wrote(tmp_path: Path) -> None:
    values = np.array([[0, 1, 65535], [300, 7, 256]], dtype=np.uint16)
    write_grey(tmp_path / "m.png", values)
    assert np.array_equal(png_read_grey(tmp_path / "m.png"), values)


def test_png_of_16_bits_keeps_its_values(tmp_path: Path) -> None:
    values = np.array([[0, 1, 65535], [300, 7, 256]], dtype=np.uint16)
    write_grey(tmp_path / "m.png", values)
    assert np.array_equal(read_grey(tmp_path / "m.png"), values)


def test_training_scenes_take_species_in_turn_and_start_at_their_own_seeds() -> None:
    configs = [training_config(FIRST_TRAINING_SEED + i) for i in range(24)]
    assert {c.species for c in configs} == set(SPECIES)
    assert all(c.seed >= 1000 for c in configs)
    assert {c.close_ups for c in configs} == {True, False}
    assert len({(c.species, c.variant) for c in configs}) > 16
    assert len({c.form for c in configs}) > 2
    for config in configs:
        check(config)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"species": "durian"}, "durian"),
        ({"variant": "blue"}, "blue"),
        ({"views": 0}, "views"),
        ({"form": "hedge"}, "form 'hedge'"),
        ({"path": "spiral"}, "path 'spiral'"),
        ({"aim": "sky"}, "aim 'sky'"),
        ({"clump": 0.5}, "clump is 0.5"),
        ({"spread": 0.9}, "spread is 0.9"),
        ({"trees": 0}, "trees is 0"),
        ({"neighbours": -1}, "neighbours is -1"),
        ({"posts": -2}, "posts is -2"),
        ({"tags": -1}, "tags is -1"),
        ({"flowers": -1}, "flowers is -1"),
        ({"exposure_drift": -0.1}, "exposure_drift is -0.1"),
        ({"white_balance_drift": 3.0}, "white_balance_drift is 3.0"),
        ({"motion_blur": float("nan")}, "motion_blur is nan"),
        ({"leaf_motion": 100.0}, "leaf_motion is 100.0"),
        ({"pose_noise": -1.0}, "pose_noise is -1.0"),
        ({"tree_height": 0.1}, "tree_height is 0.1"),
        ({"aim": "part", "trees": 2}, "aim part"),
        ({"fruits": 20000, "trees": 2}, "32000"),
    ],
)
def test_a_setting_that_makes_no_sense_is_named(wrong: dict[str, object], word: str) -> None:
    with pytest.raises(OrchardError, match=word):
        check(OrchardConfig(**wrong))  # type: ignore[arg-type]


def test_more_fruit_than_the_tree_holds_is_an_error() -> None:
    rng = np.random.default_rng(0)
    trunk_and_a_limb = grow(rng, SPECIES["mango"])[:2]
    fruiting = Fruiting(rng, SPECIES["mango"], trunk_and_a_limb)
    with pytest.raises(OrchardError, match="ask for fewer"):
        fruiting.hang(300)


@pytest.mark.parametrize(("flags", "word"), [(("--seed", "-3"), "seed is -3"), (("--preview", "-1"), "preview is -1")])
def test_a_flag_below_its_least_value_is_one_line_and_leaves_no_folder(
    flags: tuple[str, ...], word: str, tmp_path: Path
) -> None:
    done = make(tmp_path / "scene", *flags)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert word in done.stderr
    assert not (tmp_path / "scene").exists()


def test_a_python_without_bpy_is_told_how_to_install_it(tmp_path: Path) -> None:
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
def test_an_interrupt_ends_the_walk_with_130(tmp_path: Path) -> None:
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
        "import ctypes, sys; sys.path.insert(0, sys.argv[1]); from orchard.render import quiet\n"
        "libc = ctypes.CDLL(None); puts = libc.puts; held = ctypes.create_string_buffer(4096)\n"
        "libc.setvbuf(ctypes.c_void_p.in_dll(libc, 'stdout'), held, 0, 4096)  # bpy may have left it unbuffered\n"
        "puts(b'before')\nwith quiet(): puts(b'while')\nputs(b'after'); libc.fflush(None)"
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
def test_fruit_of_a_row_tell_their_tree_and_those_of_neighbours_are_never_visible(varied: Path) -> None:
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
    compared = compare(tally(truth.trees, places.numbers), assign_to_trees(truth.centers[row], places))
    assert compared.true.tolist() == [12, 12]
    assert compared.counted.sum() >= 20


@needs_bpy
def test_a_killed_walk_goes_on_to_the_same_bytes(varied: Path, tmp_path: Path) -> None:
    out = tmp_path / "again"
    scene_file = str(varied.parent / "row.toml")
    assert make(out, "--scene", scene_file, "--fallen", "0", "--preview", "1").returncode == 0
    assert make(out, "--scene", scene_file, "--fallen", "0").returncode == 0
    for name in ("truth.json", "images/001.jpg", "images/002.jpg", "instances/003.png", "depth/003.png"):
        assert (out / name).read_bytes() == (varied / name).read_bytes()
