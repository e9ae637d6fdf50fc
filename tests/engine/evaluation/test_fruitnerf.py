"""FruitNeRF folders: masks by view, and the true fruit of the mesh next to them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from fruitlangs.engine.config import SceneConfig
from fruitlangs.engine.errors import FormatError, SceneError
from fruitlangs.engine.evaluation.datasets.fruitnerf import read_fruit_masks, read_fruitnerf_truth

FRUIT = np.array([[0.3, 0.0, 0.5], [-0.2, 0.4, 1.0], [0.1, -0.3, 1.4]])
WIDTH, HEIGHT, FOCAL = 80, 60, 70.0


def look(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(4, 4) camera to world with OpenGL axes, z up in the world."""
    backward = (position - target) / np.linalg.norm(position - target)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(backward, right), backward], axis=1)
    pose[:3, 3] = position
    return pose


def mask_of(pose: np.ndarray, radius: float) -> np.ndarray:
    """(H, W) uint8, 255 where a ball of `radius` at any of FRUIT is seen."""
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(column - WIDTH / 2) / FOCAL, -(row - HEIGHT / 2) / FOCAL, -np.ones_like(row)], axis=2)
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True) @ pose[:3, :3].T
    offsets = FRUIT - pose[:3, 3]
    closest = np.einsum("hwj,kj->hwk", rays, offsets)
    return np.where(((offsets**2).sum(axis=1) - closest**2 < radius**2).any(axis=2), 255, 0).astype(np.uint8)


def write_mesh(path: Path, centers: np.ndarray, radius: float) -> None:
    """An .obj of one ball an object, as Blender writes it."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    lines = []
    for number, center in enumerate(centers):
        lines += [f"o apple.{number:03d}", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in ball.vertices + center), "s 1"]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in ball.faces + number * len(ball.vertices)]
    path.write_text("\n".join(["# Blender", *lines]) + "\n")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Five photos of three balls, masks that the frames name, and the mesh in the cameras' frame."""
    (tmp_path / "images").mkdir()
    (tmp_path / "semantics").mkdir()
    frames = []
    for number, angle in enumerate(np.linspace(0, 2 * np.pi, 5, endpoint=False)):
        pose = look(np.array([3 * np.cos(angle), 3 * np.sin(angle), 1.2]), np.array([0.0, 0.0, 0.9]))
        name = f"{number:03d}.png"
        Image.new("RGB", (WIDTH, HEIGHT), (90, 120, 60)).save(tmp_path / "images" / name)
        Image.fromarray(mask_of(pose, 0.15)).save(tmp_path / "semantics" / name)
        frame = {"file_path": f"images/{name}", "semantic_path": f"semantics/{name}"}
        frames.append({**frame, "transform_matrix": pose.tolist()})
    lens = {"fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "semantics": ["stuff", "apple"], "frames": frames}))
    write_mesh(tmp_path / "fruits.obj", FRUIT, 0.15)
    return tmp_path


def change(folder: Path, **fields: object) -> None:
    """Set fields of every frame; None takes one away."""
    content = json.loads((folder / "transforms.json").read_text())
    for frame in content["frames"]:
        for key, value in fields.items():
            frame.pop(key) if value is None else frame.update({key: value})
    (folder / "transforms.json").write_text(json.dumps(content))


def test_masks_are_true_on_fruit_in_the_order_of_the_views(tree: Path) -> None:
    masks = read_fruit_masks(tree)
    assert [mask.name for mask in masks] == [f"images/{number:03d}.png" for number in range(5)]
    for number, mask in enumerate(masks):
        stored = np.asarray(Image.open(tree / "semantics" / f"{number:03d}.png"))
        assert (mask.pixels() == (stored == 255)).all()
        assert 0 < mask.pixels().sum() < 0.2 * WIDTH * HEIGHT


def test_masks_shrink_with_the_photos(tree: Path) -> None:
    assert read_fruit_masks(tree, SceneConfig(downscale=2))[0].pixels().shape == (HEIGHT // 2, WIDTH // 2)


def test_masks_that_no_frame_names_are_found_in_the_folder(tree: Path) -> None:
    change(tree, semantic_path=None)
    (tree / "semantics" / "000.png").rename(tree / "semantics" / "000.PNG")
    assert read_fruit_masks(tree)[0].pixels().any()


def test_a_path_written_on_windows_is_understood(tree: Path) -> None:
    content = json.loads((tree / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["semantic_path"] = frame["semantic_path"].replace("/", "\\")
    (tree / "transforms.json").write_text(json.dumps(content))
    assert len(read_fruit_masks(tree)) == 5


def test_a_mask_of_class_numbers_means_the_same(tree: Path) -> None:
    path = tree / "semantics" / "000.png"
    before = read_fruit_masks(tree)[0].pixels()
    Image.fromarray(np.asarray(Image.open(path)) // 255).save(path)
    assert (read_fruit_masks(tree)[0].pixels() == before).all()


def test_jpeg_noise_is_no_fruit(tree: Path) -> None:
    change(tree, semantic_path="semantics/noise.jpg")
    Image.new("L", (WIDTH, HEIGHT), 1).save(tree / "semantics" / "noise.jpg")
    assert not read_fruit_masks(tree)[0].pixels().any()


def test_a_missing_mask_names_the_photo(tree: Path) -> None:
    change(tree, semantic_path=None)
    (tree / "semantics" / "003.png").unlink()
    with pytest.raises(SceneError, match=r"images/003\.png has no fruit mask"):
        read_fruit_masks(tree)


def test_a_mask_of_another_shape_names_its_file(tree: Path) -> None:
    Image.new("L", (WIDTH, WIDTH)).save(tree / "semantics" / "002.png")
    with pytest.raises(SceneError, match=r"002\.png has 80x80 pixels"):
        read_fruit_masks(tree)


def test_every_object_of_the_mesh_is_a_fruit_with_its_centre_and_diameter(tree: Path) -> None:
    imported = read_fruitnerf_truth(tree)
    assert imported.label == "apple"
    assert imported.names == ("apple.000", "apple.001", "apple.002")
    assert np.allclose(imported.truth.centers, FRUIT, atol=1e-5)
    assert imported.truth.diameters == pytest.approx([0.3, 0.3, 0.3], rel=0.01)
    assert "as it is, times 1" in imported.remarks[0]


def test_the_masks_find_a_mesh_that_is_y_up_and_twice_as_large(tree: Path) -> None:
    write_mesh(tree / "fruits.obj", 2.0 * FRUIT @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]], 0.3)
    imported = read_fruitnerf_truth(tree)
    assert np.allclose(imported.truth.centers, FRUIT, atol=1e-5)
    assert imported.truth.diameters == pytest.approx([0.3, 0.3, 0.3], rel=0.01)
    assert "y up to z up, times 0.5" in imported.remarks[0]


def test_a_mesh_of_another_tree_is_refused(tree: Path) -> None:
    write_mesh(tree / "fruits.obj", FRUIT + [0.0, 0.0, -0.45], 0.15)
    with pytest.raises(FormatError, match="could not be aligned"):
        read_fruitnerf_truth(tree)


def test_without_masks_the_mesh_is_taken_as_it_is_and_a_remark_says_so(tree: Path) -> None:
    change(tree, semantic_path=None)
    (tree / "semantics").rename(tree / "elsewhere")
    write_mesh(tree / "fruits.obj", FRUIT + [9.0, 0.0, 0.0], 0.15)
    imported = read_fruitnerf_truth(tree)
    assert imported.truth.centers[0] == pytest.approx([9.3, 0.0, 0.5])
    assert "could not be checked" in imported.remarks[0]


def test_a_real_tree_without_a_mesh_says_what_is_missing(tree: Path) -> None:
    (tree / "fruits.obj").unlink()
    with pytest.raises(FormatError, match=r"expected one \.obj with the true fruit, found none"):
        read_fruitnerf_truth(tree)


def test_a_vertex_that_is_no_number_names_its_line(tree: Path) -> None:
    (tree / "fruits.obj").write_text("o a\nv 0 0 0\nv 1 nan 0\n")
    with pytest.raises(FormatError, match=r"fruits\.obj: line 3"):
        read_fruitnerf_truth(tree)


def test_a_flat_object_is_no_fruit(tree: Path) -> None:
    (tree / "fruits.obj").write_text("o leaf\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n")
    with pytest.raises(FormatError, match="object leaf is flat"):
        read_fruitnerf_truth(tree)


def test_the_label_is_one_kind_of_fruit(tree: Path) -> None:
    assert read_fruitnerf_truth(tree, label="Pears").label == "pear"
    with pytest.raises(FormatError, match="'fruit' is not one kind"):
        read_fruitnerf_truth(tree, label="fruit")
