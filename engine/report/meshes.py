"""Fruit as geometry: labelled meshes (GLB) and the sampled points with fruit ids (PLY)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from ..counting.fruit import FruitCount
from .words import object_name

_PALETTE_STEP = 0.61803398875
"""Golden ratio: neighbouring ids get hues that are far apart."""


def id_color(fruit_id: int) -> tuple[int, int, int]:
    """A distinct sRGB colour of a fruit id; grey for -1 (no fruit)."""
    if fruit_id < 0:
        return (128, 128, 128)
    hue = (fruit_id * _PALETTE_STEP) % 1.0
    # The three colour channels are one raised cosine, shifted: bright and equally light all around the circle.
    channels = 0.55 + 0.42 * np.cos(2 * np.pi * (hue - np.array([0.0, 1 / 3, 2 / 3])))
    red, green, blue = (int(value) for value in np.round(channels * 255))
    return (red, green, blue)


def write_glb(path: Path, fruit_count: FruitCount, up: NDArray[np.float64]) -> None:
    """One named ellipsoid a fruit, its properties as glTF extras; glTF's y axis is the scene's up; scene units."""
    scene = trimesh.Scene()
    rotation = trimesh.geometry.align_vectors(up, [0.0, 1.0, 0.0])
    for fruit in fruit_count.fruits:
        mesh = trimesh.creation.icosphere(subdivisions=2)
        mesh.vertices = mesh.vertices @ fruit.axes
        mesh.visual = trimesh.visual.TextureVisuals(
            material=trimesh.visual.material.PBRMaterial(
                baseColorFactor=[*id_color(fruit.id), 255], roughnessFactor=0.6
            )
        )
        mesh.metadata = {
            "id": fruit.id,
            "label": fruit.label,
            "diameter": fruit.diameter,
            "axes": fruit.axes.tolist(),
            "probability": fruit.probability,
            "visible_fraction": fruit.visible_fraction,
            "views": fruit.views,
            "color": fruit.color.tolist(),
            "kind": fruit.kind,
            "fallen": fruit.fallen,
            "tree": fruit.tree,
        }
        name = object_name(fruit)
        pose = rotation @ trimesh.transformations.translation_matrix(fruit.center)
        scene.add_geometry(mesh, node_name=name, geom_name=name, transform=pose)
    path.write_bytes(scene.export(file_type="glb") if fruit_count.fruits else _empty_glb())


def _empty_glb() -> bytes:
    """A valid glTF binary with an empty scene: trimesh refuses to export one, yet zero fruit is an answer."""
    content = b'{"asset":{"version":"2.0","generator":"FruitLangs"},"scene":0,"scenes":[{}]}'
    content += b" " * (-len(content) % 4)
    chunk = len(content).to_bytes(4, "little") + b"JSON" + content
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunk)).to_bytes(4, "little") + chunk


def write_points_ply(path: Path, fruit_count: FruitCount) -> None:
    """The sampled surface points in the scene's frame, with colour and `fruit_id` (-1: no fruit)."""
    points = np.empty(
        len(fruit_count.points),
        dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
        + [("red", "u1"), ("green", "u1"), ("blue", "u1"), ("fruit_id", "<i4")],
    )
    for axis, name in enumerate("xyz"):
        points[name] = fruit_count.points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        points[name] = fruit_count.point_colors[:, channel]
    points["fruit_id"] = fruit_count.point_fruit_ids
    PlyData([PlyElement.describe(points, "vertex")], byte_order="<").write(str(path))
