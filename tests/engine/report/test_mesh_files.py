"""Fruit as files of meshes: GLB, OBJ and PLY agree on place, size, unit and colour."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from fruit_examples import NO_FRUIT, count_of, fruit
from plyfile import PlyData

from fruitlangs.engine.errors import OutputError
from fruitlangs.engine.report.meshes import id_color, write_fruit_meshes_ply, write_glb, write_obj, write_points_ply

UP = np.array([0.0, 0.0, 1.0])
TWO = count_of(fruit(1, 0.0), fruit(7, 1.0))
WRITERS: dict[str, Callable[..., None]] = {"glb": write_glb, "obj": write_obj, "ply": write_fruit_meshes_ply}


def extras(path: Path) -> dict:
    header = path.read_bytes()
    length = int.from_bytes(header[12:16], "little")
    return json.loads(header[20 : 20 + length])["meshes"][0]["extras"]


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_fruit_keeps_its_place_and_its_three_lengths(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"fruits.{suffix}"
    WRITERS[suffix](path, count_of(fruit(1, 3.0)), None)
    low, high = trimesh.load(path).bounds
    assert (low + high) / 2 == pytest.approx([3.0, 0.5, -1.0], abs=1e-4)
    assert high - low == pytest.approx([0.08, 0.04, 0.16], rel=0.02)


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_known_scale_gives_metres_and_an_unknown_one_scene_units(suffix: str, tmp_path: Path) -> None:
    for metres_per_unit in (None, 0.5):
        path = tmp_path / f"{metres_per_unit}.{suffix}"
        WRITERS[suffix](path, TWO, metres_per_unit)
        unit = (
            extras(path)["unit"] if suffix == "glb" else path.read_bytes().split(b"unit: ")[1].split(b"\n")[0].decode()
        )
        assert unit == ("scene units" if metres_per_unit is None else "m")
    plain, metres = (trimesh.load(tmp_path / f"{name}.{suffix}").bounds for name in (None, 0.5))
    assert metres == pytest.approx(0.5 * plain, abs=1e-5)


@pytest.mark.parametrize("suffix", WRITERS)
def test_up_of_the_scene_becomes_y(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"fruits.{suffix}"
    WRITERS[suffix](path, TWO, None, up=UP)
    low, high = trimesh.load(path).bounds
    assert (low[1] + high[1]) / 2 == pytest.approx(-1.0, abs=1e-4)  # z in the scene
    assert high[1] - low[1] == pytest.approx(0.16, rel=0.02)


@pytest.mark.parametrize("suffix", WRITERS)
def test_no_fruit_gives_a_valid_file_without_meshes(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"fruits.{suffix}"
    WRITERS[suffix](path, NO_FRUIT, None)
    if suffix == "glb":
        assert len(trimesh.load(path).geometry) == 0
    elif suffix == "obj":
        assert all(line.startswith(("#", "mtllib ")) for line in path.read_text().splitlines())
    else:
        assert [len(element) for element in PlyData.read(str(path)).elements] == [0, 0]


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_folder_that_cannot_be_written_is_reported(suffix: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError, match="cannot be written"):
        WRITERS[suffix](tmp_path / "file" / f"fruits.{suffix}", TWO, None)


def test_the_glb_names_every_mesh_and_carries_its_properties(tmp_path: Path) -> None:
    write_glb(tmp_path / "fruits.glb", TWO, 0.5)
    assert sorted(trimesh.load(tmp_path / "fruits.glb").geometry) == ["red apple.001", "red apple.007"]
    found = extras(tmp_path / "fruits.glb")
    assert (found["probability"], found["diameter"]) == (0.9, 0.04)


def test_the_obj_has_one_object_a_fruit_without_spaces_in_its_name(tmp_path: Path) -> None:
    write_obj(tmp_path / "fruits.obj", TWO, None)
    names = [line for line in (tmp_path / "fruits.obj").read_text().splitlines() if line.startswith("o ")]
    assert names == ["o fruit_0001_red_apple", "o fruit_0007_red_apple"]


def test_the_obj_finds_the_colours_of_its_fruit_next_to_it(tmp_path: Path) -> None:
    write_obj(tmp_path / "fruits.obj", TWO, None)
    loaded = trimesh.load(tmp_path / "fruits.obj", group_material=False, split_object=True)
    colors = {tuple(mesh.visual.material.diffuse[:3].tolist()) for mesh in loaded.geometry.values()}
    assert colors == {id_color(1), id_color(7)}


def test_normals_of_the_obj_stand_on_its_faces_and_point_outward(tmp_path: Path) -> None:
    write_obj(tmp_path / "fruits.obj", count_of(fruit(1, 0.0)), None, up=UP)
    rows = [line.split() for line in (tmp_path / "fruits.obj").read_text().splitlines()]
    normals = np.array([row[1:] for row in rows if row[0] == "vn"], float)
    mesh = trimesh.load(tmp_path / "fruits.obj", process=False)
    exact = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
    assert (np.einsum("ni,ni->n", normals, exact) > 0.97).all()
    assert mesh.volume > 0


def test_every_vertex_and_face_of_the_ply_gives_its_fruit(tmp_path: Path) -> None:
    write_fruit_meshes_ply(tmp_path / "fruits.ply", TWO, None)
    read = PlyData.read(str(tmp_path / "fruits.ply"))
    vertex, face = read["vertex"], read["face"]
    corners = np.stack(face["vertex_indices"])
    assert (vertex["fruit_id"][corners] == face["fruit_id"][:, None]).all()
    assert set(face["fruit_id"]) == {1, 7}
    on_seven = vertex["fruit_id"] == 7
    assert np.allclose(vertex["x"][on_seven].mean(), 1.0, atol=1e-3)
    assert {tuple(int(vertex[name][row]) for name in ("red", "green", "blue")) for row in np.flatnonzero(on_seven)} == {
        id_color(7)
    }


def test_the_ply_is_one_closed_surface_a_fruit(tmp_path: Path) -> None:
    write_fruit_meshes_ply(tmp_path / "fruits.ply", TWO, None)
    mesh = trimesh.load(tmp_path / "fruits.ply")
    assert mesh.is_watertight
    assert mesh.body_count == 2
    assert mesh.volume == pytest.approx(2 * TWO.fruits[0].volume, rel=0.1)


def test_points_carry_their_fruit(tmp_path: Path) -> None:
    counted = count_of(
        fruit(1, 0.0),
        points=np.array([[0.0, 0.54, -1.0], [9.0, 9.0, 9.0]]),
        point_colors=np.array([[200, 10, 10], [0, 0, 0]], np.uint8),
        point_fruit_ids=np.array([1, -1]),
    )
    write_points_ply(tmp_path / "fruits.ply", counted)
    vertex = PlyData.read(str(tmp_path / "fruits.ply"))["vertex"]
    assert vertex["fruit_id"].tolist() == [1, -1]
    assert vertex["red"].tolist() == [200, 0]
