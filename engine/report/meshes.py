"""Fruit as geometry: labelled meshes (GLB, OBJ, PLY) and the sampled points with fruit ids (PLY).

Every mesh is an ellipsoid with the axes of the fruit. Its vertices are in metres if the scale is known, else in scene
units; the file says which. With `up` (3,) of the scene, y is up, as glTF requires and programs expect of an OBJ;
without it the mesh stays in the scene frame. A count of 0 gives a valid file without meshes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from ..counting.fruit import Fruit, FruitCount
from ..storage.files import replace_file, write_text
from .words import file_unit, object_name

FloatArray = NDArray[np.float64]

_PALETTE_STEP = 0.61803398875
"""Golden ratio: neighbouring ids get very different hues."""
_FINENESS = 2
"""Subdivisions of the icosahedron: 162 vertices and 320 faces per fruit."""


def id_color(fruit_id: int) -> tuple[int, int, int]:
    """A distinct sRGB colour of a fruit id; grey for -1 (no fruit)."""
    if fruit_id < 0:
        return (128, 128, 128)
    hue = (fruit_id * _PALETTE_STEP) % 1.0
    # The three channels are one raised cosine, shifted: bright and equally light all around the circle.
    channels = 0.55 + 0.42 * np.cos(2 * np.pi * (hue - np.array([0.0, 1 / 3, 2 / 3])))
    red, green, blue = (int(value) for value in np.round(channels * 255))
    return (red, green, blue)


@dataclass(frozen=True, eq=False)
class _Meshes:
    """F ellipsoids as triangles. vertices, normals: (F, V, 3); faces: (T, 3) the same indices for each fruit."""

    vertices: FloatArray
    normals: FloatArray
    faces: NDArray[np.int64]


def _meshes(fruits: Sequence[Fruit], scale: float, up: FloatArray | None) -> _Meshes:
    """The ellipsoids of the fruit, `scale` times as large as in scene units; y is up if `up` is given."""
    ball = trimesh.creation.icosphere(subdivisions=_FINENESS)
    turn = _rotate_up(up)[:3, :3].T
    points = np.asarray(ball.vertices, np.float64)
    axes = np.array([fruit.axes for fruit in fruits], np.float64).reshape(-1, 3, 3) @ turn
    centers = np.array([fruit.center for fruit in fruits], np.float64).reshape(-1, 1, 3) @ turn
    # The normal of a surface p = s A is its gradient s A⁻ᵀ.
    normals = points @ np.linalg.inv(axes).transpose(0, 2, 1)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return _Meshes(scale * (centers + points @ axes), normals, np.asarray(ball.faces, np.int64))


def _rotate_up(up: FloatArray | None) -> FloatArray:
    """Return the rotation (4, 4) that takes `up` to y; the identity without it."""
    return np.eye(4) if up is None else trimesh.geometry.align_vectors(up, [0.0, 1.0, 0.0])


def write_glb(
    path: Path, fruit_count: FruitCount, metres_per_unit: float | None, *, up: FloatArray | None = None
) -> None:
    """One named ellipsoid per fruit with its properties as glTF extras; `unit` is the unit of all lengths."""
    scene = trimesh.Scene()
    unit, scale = file_unit(metres_per_unit)
    rotation = _rotate_up(up)
    for fruit in fruit_count.fruits:
        mesh = trimesh.creation.icosphere(subdivisions=_FINENESS)
        mesh.vertices = mesh.vertices @ (scale * fruit.axes)
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*id_color(fruit.id), 255], roughnessFactor=0.6
            )
        )
        mesh.metadata = {
            "id": fruit.id,
            "label": fruit.label,
            "unit": unit,
            "diameter": fruit.diameter * scale,
            "axes": (fruit.axes * scale).tolist(),
            "probability": fruit.probability,
            "visible_fraction": fruit.visible_fraction,
            "views": fruit.views,
            "color": fruit.color.tolist(),
            "kind": fruit.kind,
            "fallen": fruit.fallen,
            "tree": fruit.tree,
        }
        name = object_name(fruit)
        pose = rotation @ trimesh.transformations.translation_matrix(scale * fruit.center)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=pose)
    with replace_file(path) as temporary:
        temporary.write_bytes(scene.export(file_type="glb") if fruit_count.fruits else _empty_glb())


def _empty_glb() -> bytes:
    """A valid glTF binary with an empty scene: trimesh refuses to export one, but a count of 0 is a result."""
    content = b'{"asset":{"version":"2.0","generator":"FruitLangs"},"scene":0,"scenes":[{}]}'
    content += b" " * (-len(content) % 4)
    chunk = len(content).to_bytes(4, "little") + b"JSON" + content
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunk)).to_bytes(4, "little") + chunk


def write_obj(
    path: Path, fruit_count: FruitCount, metres_per_unit: float | None, *, up: FloatArray | None = None
) -> None:
    """A Wavefront OBJ, one object per fruit (`o fruit_0001_apple`), with its colours in an .mtl of the same name.

    Raises:
        OutputError: a file cannot be written.
    """
    unit, scale = file_unit(metres_per_unit)
    materials = path.with_suffix(".mtl")
    meshes = _meshes(fruit_count.fruits, scale, up)
    lines = [*_make_header(fruit_count, unit, up, "# "), f"mtllib {materials.name}"]
    for index, fruit in enumerate(fruit_count.fruits):
        first = 1 + index * meshes.vertices.shape[1]
        lines += [f"o {_obj_name(fruit)}", f"usemtl {_material(fruit)}", "s 1"]
        lines += [f"v {x:.6g} {y:.6g} {z:.6g}" for x, y, z in meshes.vertices[index].tolist()]
        lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in meshes.normals[index].tolist()]
        lines += [f"f {a}//{a} {b}//{b} {c}//{c}" for a, b, c in (meshes.faces + first).tolist()]
    colors = ["# FruitLangs"]
    for fruit in fruit_count.fruits:
        red, green, blue = (channel / 255 for channel in id_color(fruit.id))
        colors += [f"newmtl {_material(fruit)}", f"Kd {red:.4f} {green:.4f} {blue:.4f}", "Ks 0.1 0.1 0.1", "illum 2"]
    # The .obj comes last, so that it never refers to missing colours.
    write_text(materials, "\n".join(colors) + "\n")
    write_text(path, "\n".join(lines) + "\n")


def _obj_name(fruit: Fruit) -> str:
    """`fruit_0001_red_apple`: in an OBJ a name ends at the first space."""
    return "_".join([f"fruit_{fruit.id:04d}", *fruit.label.split()])


def _material(fruit: Fruit) -> str:
    return f"fruit_{fruit.id:04d}"


def _make_header(fruit_count: FruitCount, unit: str, up: FloatArray | None, mark: str = "") -> list[str]:
    """Make the header: what programs and people need to know about the numbers that follow."""
    frame = "the frame of the scene" if up is None else "y is up"
    return [f"{mark}FruitLangs: {fruit_count.count} fruit", f"{mark}unit: {unit}", f"{mark}axes: {frame}"]


def write_fruit_meshes_ply(
    path: Path, fruit_count: FruitCount, metres_per_unit: float | None, *, up: FloatArray | None = None
) -> None:
    """One PLY mesh of all fruit: vertices with colour and `fruit_id`, faces with `fruit_id` too.

    Raises:
        OutputError: the file cannot be written.
    """
    unit, scale = file_unit(metres_per_unit)
    meshes = _meshes(fruit_count.fruits, scale, up)
    fruits, corners = meshes.vertices.shape[:2]
    ids = np.array([fruit.id for fruit in fruit_count.fruits], np.int32)
    colors = np.array([id_color(fruit.id) for fruit in fruit_count.fruits], np.uint8).reshape(-1, 3)
    vertices = _points(meshes.vertices.reshape(-1, 3), np.repeat(colors, corners, axis=0), np.repeat(ids, corners))
    faces = np.empty(fruits * len(meshes.faces), dtype=[("vertex_indices", "<i4", (3,)), ("fruit_id", "<i4")])
    firsts = corners * np.arange(fruits)[:, None, None]
    faces["vertex_indices"] = (meshes.faces + firsts).reshape(-1, 3)
    faces["fruit_id"] = np.repeat(ids, len(meshes.faces))
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    with replace_file(path) as temporary:
        PlyData(elements, byte_order="<", comments=_make_header(fruit_count, unit, up)).write(str(temporary))


def write_points_ply(path: Path, fruit_count: FruitCount) -> None:
    """The sampled surface points in the scene's frame, with colour and `fruit_id` (-1: no fruit)."""
    points = _points(fruit_count.points, fruit_count.point_colors, fruit_count.point_fruit_ids)
    PlyData([PlyElement.describe(points, "vertex")], byte_order="<").write(str(path))


def _points(places: FloatArray, colors: NDArray[np.uint8], ids: NDArray[np.integer]) -> NDArray[np.void]:
    """The vertices of a PLY: positions (P, 3), colors (P, 3) and fruit ids (P,)."""
    points = np.empty(
        len(places),
        dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
        + [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("fruit_id", "<i4")],
    )
    for axis, name in enumerate("xyz"):
        points[name] = places[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        points[name] = colors[:, channel]
    points["fruit_id"] = ids
    return points
