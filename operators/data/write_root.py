"""The root empty: stands the scene upright while everything below it keeps the input scene's coordinates.

Gaussians, points, cameras and fruit are its children with untouched local coordinates, so `object.location` of a fruit
is its `center` in `fruits.json` and in the input model. The root alone turns the scene's `up` to Blender's +Z, puts the
point the cameras look at over the origin and the ground at z = 0, where a person picked it or as the points tell, and
scales scene units to metres where the scale is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import bpy
import numpy as np
from mathutils import Matrix

from ..blender_data import new_object, owned_collection, owned_object

if TYPE_CHECKING:
    from ...engine.scene.camera import FloatArray, Scene

GROUND = "fruitlangs_ground"
"""Custom property of the Blender scene: a place on the ground that a person picked, in the scene's frame."""
GROUND_PERCENTILE = 2.0
"""A robust lowest point: this share of the sparse points may lie below the ground."""


def write_root(bpy_scene: bpy.types.Scene, scene: Scene) -> bpy.types.Object:
    """Place this Blender scene's root empty for `scene`; it is made where there is none."""
    root = owned_object(bpy_scene, "root")
    if root is None:
        root = new_object("FruitLangs", None, "root", owned_collection(bpy_scene, "scene", "FruitLangs"), None)
        root.empty_display_type = "PLAIN_AXES"
    root.empty_display_size = 0.05 * scene.extent if len(scene.cameras) else 1.0
    root["metres_per_unit"] = scene.metres_per_unit or 0.0
    root.matrix_basis = root_matrix(scene, bpy_scene.get(GROUND))
    return root


def root_matrix(scene: Scene, ground: Sequence[float] | None = None) -> Matrix:
    """How the root stands for `scene`; ground: a place that a person picked, in its frame."""
    matrix = upright_matrix(scene)
    if ground is not None:
        matrix[2, 3] = -matrix[2, :3] @ np.array(ground)
    return Matrix.Scale(scene.metres_per_unit or 1.0, 4) @ Matrix(matrix.tolist())


def upright_matrix(scene: Scene) -> FloatArray:
    """(4, 4) rigid transform from the scene's frame to an upright one: centre over the origin, ground at z = 0."""
    from ...engine.scene.orientation import upright_rotation

    matrix = np.eye(4)
    matrix[:3, :3] = upright_rotation(scene.up)
    center = matrix[:3, :3] @ looked_at(scene)
    points = scene.points @ matrix[:3, :3].T
    if len(points):
        reach = 1.5 * scene.extent if len(scene.cameras) else np.inf
        near = points[np.linalg.norm(points[:, :2] - center[:2], axis=1) <= reach]
        center[2] = np.percentile((near if len(near) else points)[:, 2], GROUND_PERCENTILE)
    matrix[:3, 3] = -center
    return matrix


def looked_at(scene: Scene) -> FloatArray:
    """(3,) the point nearest to all viewing rays by least squares; the points' median where the rays are parallel."""
    from ...engine.scene.camera import axes_equations

    fallback = np.median(scene.points, axis=0) if len(scene.points) else np.zeros(3)
    if not len(scene.cameras):
        return fallback
    normal, right = axes_equations(scene.cameras)
    if np.linalg.cond(normal) > 1e4:
        return fallback
    return np.linalg.solve(normal, right)
