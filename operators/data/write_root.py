"""The root empty: makes the scene upright while everything below it keeps the coordinates of the input scene.

Gaussians, points, cameras and fruit are its children with unchanged local coordinates, so `object.location` of a fruit
is its `center` in `fruits.json` and in the input model. The root alone rotates the scene's `up` to Blender's +Z, puts
the point that the cameras look at over the origin and the ground at z = 0 (as picked by the user or estimated from the
points), and scales scene units to metres if the scale is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import bpy
import numpy as np
from mathutils import Matrix

from ...engine.errors import SceneError
from ..blender_data import OWNER, Role, ensure_owned_collection, find_owned_object, find_owned_objects, make_object
from ..root_placement import place_root, placement_of, root_frame
from ..scene_frame import SceneFrame, scene_frame

if TYPE_CHECKING:
    from ...engine.scene.camera import FloatArray, Scene

METRES = "metres_per_unit"
"""Custom property of the root: metres per scene unit, 0 if unknown."""
GROUND = "fruitlangs_ground"
"""Custom property of the Blender scene: a point on the ground that the user picked, in the scene frame."""
BELOW: tuple[Role, ...] = ("gaussians", "points", "camera", "fruit", "region")
"""Roles of objects below the root."""
GROUND_PERCENTILE = 2.0
"""Share of the sparse points that may lie below the ground: a robust lowest point."""


def write_root(bpy_scene: bpy.types.Scene, scene: Scene) -> bpy.types.Object:
    """Place this Blender scene's root empty for `scene`, creating it if necessary.

    The user's placement of an existing root stays (see `root_placement`). What stays below it keeps its place in the
    scene frame, also where the old root's transform was applied.
    """
    kept, frame = _find_displaced(bpy_scene), root_frame(bpy_scene)
    root = find_owned_object(bpy_scene, "root")
    if root is None:
        root = make_object("FruitLangs", None, "root", ensure_owned_collection(bpy_scene, "scene", "FruitLangs"), None)
        root.empty_display_type = "PLAIN_AXES"
    root.empty_display_size = 0.05 * scene.extent if len(scene.cameras) else 1.0
    _scale_clipping(bpy_scene, (scene.metres_per_unit or 1.0) / (float(root.get(METRES, 0.0)) or 1.0))
    root[METRES] = scene.metres_per_unit or 0.0
    placement = None if frame is None else placement_of(frame)
    if kept:  # they are put below the root again, with the pose that they have in the scene frame
        frame = None
    place_root(frame or SceneFrame(root, Matrix()), root_matrix(scene, bpy_scene.get(GROUND)), placement)
    for item, place in kept.items():
        _put_below(item, root, place)
    return root


def _scale_clipping(bpy_scene: bpy.types.Scene, ratio: float) -> None:
    """Scale the clipping of cameras that are used again: unlike everything else below the root it is in world units."""
    for item in find_owned_objects(bpy_scene, "camera") if ratio != 1.0 else ():
        item.data.clip_start *= ratio
        item.data.clip_end *= ratio


def _find_displaced(bpy_scene: bpy.types.Scene) -> dict[bpy.types.Object, Matrix]:
    """Return {object of ours: its transform in the scene frame} of those that an applied or cleared root displaced."""
    try:
        frame = scene_frame(bpy_scene)
        items = [item for role in BELOW for item in find_owned_objects(bpy_scene, role)]
        displaced = (item for item in items if item.parent != frame.root or frame.in_root != Matrix())
        return {item: frame.of(item) for item in displaced}
    except SceneError:  # there is no root yet, or nothing is known about where they are
        return {}


def _put_below(item: bpy.types.Object, root: bpy.types.Object, place: Matrix) -> None:
    """Place an object in the scene frame; the region keeps its side lengths in the sidebar."""
    item.parent = root
    if item.get(OWNER) == "region":
        item.matrix_parent_inverse = place @ item.matrix_basis.inverted_safe()
    else:
        item.matrix_parent_inverse, item.matrix_basis = Matrix(), place


def root_matrix(scene: Scene, ground: Sequence[float] | None = None) -> Matrix:
    """The matrix of the root for `scene`; ground: a point that the user picked, in its frame."""
    matrix = compute_upright_matrix(scene)
    if ground is not None:
        matrix[2, 3] = -matrix[2, :3] @ np.array(ground)
    return Matrix.Scale(scene.metres_per_unit or 1.0, 4) @ Matrix(matrix.tolist())


def compute_upright_matrix(scene: Scene) -> FloatArray:
    """Compute the rigid transform (4, 4) from the scene frame to an upright one: centre over the origin, ground at z =
    0."""
    from ...engine.scene.orientation import upright_rotation

    matrix = np.eye(4)
    matrix[:3, :3] = upright_rotation(scene.up)
    center = matrix[:3, :3] @ find_focus(scene)
    points = scene.points @ matrix[:3, :3].T
    if len(points):
        reach = 1.5 * scene.extent if len(scene.cameras) else np.inf
        near = points[np.linalg.norm(points[:, :2] - center[:2], axis=1) <= reach]
        center[2] = np.percentile((near if len(near) else points)[:, 2], GROUND_PERCENTILE)
    matrix[:3, 3] = -center
    return matrix


def find_focus(scene: Scene) -> FloatArray:
    """Find the point (3,) nearest to all viewing rays by least squares; the median of the points if the rays are
    parallel."""
    from ...engine.scene.camera import axes_equations

    fallback = np.median(scene.points, axis=0) if len(scene.points) else np.zeros(3)
    if not len(scene.cameras):
        return fallback
    normal, right = axes_equations(scene.cameras)
    if np.linalg.cond(normal) > 1e4:
        return fallback
    return np.linalg.solve(normal, right)
