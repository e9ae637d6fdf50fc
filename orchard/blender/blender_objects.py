"""Plain arrays as Blender objects."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..shapes.meshes import Mesh

FloatArray = NDArray[np.float64]


def make_mesh_data(name: str, mesh: Mesh, material: Any, *, smooth: bool = True) -> Any:
    """Make a Blender mesh with the colours of `mesh`, if any, as its attribute tint."""
    data = bpy.data.meshes.new(name)
    faces = [q[:3] if q[2] == q[3] else q for q in mesh.quads.tolist()]
    data.from_pydata(mesh.vertices.tolist(), [], faces)
    data.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
    if len(mesh.colors):
        layer = data.attributes.new("tint", "FLOAT_COLOR", "POINT")
        rgba = np.ones((len(mesh.vertices), 4), dtype=np.float32)
        rgba[:, :3] = mesh.colors
        layer.data.foreach_set("color", rgba.ravel())
    data.materials.append(material)
    return data


def add_object(name: str, data: Any, collection: Any = None) -> Any:
    """Add an object in the scene, or in a collection that is not."""
    thing = bpy.data.objects.new(name, data)
    (collection or bpy.context.scene.collection).objects.link(thing)
    return thing


def matrix_of(frame: FloatArray, place: FloatArray, scale: float) -> list[list[float]]:
    """The matrix of an object from a rotation (3, 3), a position (3,) and a scale, in the order of Blender's setter."""
    matrix = np.eye(4)
    matrix[:3, :3] = frame * scale
    matrix[:3, 3] = place
    return matrix.T.tolist()  # foreach-style column order: Blender's matrix_world setter takes columns
