"""The scene frame of a Blender scene: the coordinates and units of the input model, below the root.

Blender's Apply Transform bakes the root's matrix into its children, and Clear Parent takes them out of it. Neither
changes the scene, so neither may change a number. Therefore the writers store the pose of an object in the scene frame
in a custom property (`POSE`). The current places of the cameras, Gaussians and points, compared with these poses, give
the scene frame. It is the one that most of them agree on, so a single one may be moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..engine.errors import SceneError
from .blender_data import find_owned_object, find_owned_objects

POSE = "scene_pose"
"""Custom property of a photo's camera and of a fruit: the matrix in the scene frame as it was written, 16 numbers in
rows."""
TOLERANCE = 1e-4
"""Largest difference between two placements of an object that agree, relative to the scene's size and to the scale."""
REMEDY = "Undo the last Apply, parenting or move, or import the result again"


@dataclass(frozen=True, eq=False)
class SceneFrame:
    """root: the root empty; in_root: (4, 4) from the scene frame to the root's own, the identity until the user applies
    the root's transform."""

    root: bpy.types.Object
    in_root: Matrix

    @property
    def to_world(self) -> Matrix:
        """(4, 4) from the scene frame to the world, as it was set, evaluated or not."""
        return find_world_matrix(self.root) @ self.in_root

    @property
    def world_scale(self) -> float:
        """Blender units per unit of the scene frame, as the world shows it."""
        return float(abs(self.to_world.to_3x3().determinant()) ** (1.0 / 3.0))

    def from_world(self) -> Matrix:
        """(4, 4) from the world to the scene frame.

        Raises:
            SceneError: the root is scaled to 0.
        """
        return _invert(self.to_world)

    def of(self, item: bpy.types.Object) -> Matrix:
        """(4, 4) an object's transform in the scene frame, as it was set, evaluated or not.

        Raises:
            SceneError: the root is scaled to 0, and the object is not its child.
        """
        if item.parent != self.root:
            return self.from_world() @ find_world_matrix(item)
        below = item.matrix_parent_inverse @ item.matrix_basis
        return below if self.in_root == Matrix() else _invert(self.in_root) @ below


def scene_frame(bpy_scene: bpy.types.Scene) -> SceneFrame:
    """The scene frame of this Blender scene.

    Raises:
        SceneError: it has no root, or its objects do not agree on a frame.
    """
    root = find_owned_object(bpy_scene, "root")
    if root is None:
        raise SceneError("The scene's root empty was deleted. Undo that, or import or count again")
    return SceneFrame(root, _find_frame_in_root(bpy_scene, root))


def find_world_matrix(item: bpy.types.Object) -> Matrix:
    """Return an object's transform (4, 4) in the world, as it was set; the evaluated one where constraints, bones or
    the like decide."""
    if len(item.constraints) or (item.parent is not None and item.parent_type != "OBJECT"):
        return item.matrix_world.copy()
    if item.parent is None:
        return item.matrix_basis.copy()
    return find_world_matrix(item.parent) @ item.matrix_parent_inverse @ item.matrix_basis


def keep_pose(item: bpy.types.Object) -> None:
    """Store where a child of the root was written."""
    item[POSE] = [value for row in item.matrix_basis for value in row]


def read_stored_pose(item: bpy.types.Object) -> NDArray[np.float64] | None:
    """Read the pose (4, 4) that `keep_pose` stored; None for a file of an earlier version."""
    return np.array(item[POSE], np.float64).reshape(4, 4) if POSE in item else None


def _invert(matrix: Matrix) -> Matrix:
    try:
        return matrix.inverted()
    except ValueError as error:
        raise SceneError(
            "The scene's root is scaled to 0, so places in it are unknown. Undo that or set its scale to 1"
        ) from error


def _find_frame_in_root(bpy_scene: bpy.types.Scene, root: bpy.types.Object) -> Matrix:
    """Find the transform (4, 4) from the scene frame to the root's, which more than half of the cameras, Gaussians and
    points agree on; without any, of the fruit."""
    items, poses = _find_anchors(bpy_scene)
    if not items:
        return Matrix()
    places = np.array([_find_in_root(item, root) for item in items], np.float64)
    if 2 * _count_agreeing(np.eye(4), poses, places) >= len(items):
        return Matrix()
    for pose, place in zip(poses, places, strict=True):
        if abs(np.linalg.det(pose)) > 0.0:
            frame = place @ np.linalg.inv(pose)
            if abs(np.linalg.det(frame)) > 0.0 and 2 * _count_agreeing(frame, poses, places) > len(items):
                return Matrix(frame.tolist())
    raise SceneError(f"The cameras, Gaussians and fruit do not fit together, so sizes are unknown. {REMEDY}")


def _find_anchors(bpy_scene: bpy.types.Scene) -> tuple[list[bpy.types.Object], NDArray[np.float64]]:
    """Find the objects that say where the scene frame is, and their poses in it, (A, 4, 4).

    Gaussians and points are written at its origin.
    """
    items = [item for role in ("gaussians", "points") for item in find_owned_objects(bpy_scene, role)]
    poses: list[NDArray[np.float64]] = [np.eye(4) for _ in items]
    _add_stored(find_owned_objects(bpy_scene, "camera"), items, poses)
    if not items:
        _add_stored(find_owned_objects(bpy_scene, "fruit"), items, poses)
    return items, np.array(poses).reshape(-1, 4, 4)


def _add_stored(
    found: Sequence[bpy.types.Object], items: list[bpy.types.Object], poses: list[NDArray[np.float64]]
) -> None:
    for item in found:
        pose = read_stored_pose(item)
        if pose is not None:
            items.append(item)
            poses.append(pose)


def _find_in_root(item: bpy.types.Object, root: bpy.types.Object) -> Matrix:
    """Return an object's transform (4, 4) in the root's frame."""
    if item.parent == root:
        return item.matrix_parent_inverse @ item.matrix_basis
    return _invert(find_world_matrix(root)) @ find_world_matrix(item)


def _count_agreeing(frame: NDArray[np.float64], poses: NDArray[np.float64], places: NDArray[np.float64]) -> int:
    """Count the objects with these poses (A, 4, 4) in the scene frame that stand at these places (A, 4, 4) if the scene
    frame lies at `frame` (4, 4)."""
    expected = frame @ poses
    moved = np.linalg.norm(expected[:, :3, 3] - places[:, :3, 3], axis=1)
    turned = np.abs(expected[:, :3, :3] - places[:, :3, :3]).max(axis=(1, 2))
    scale = np.abs(places[:, :3, :3]).max(axis=(1, 2))
    reach = np.linalg.norm(places[:, :3, 3], axis=1).max() + scale.max()
    return int(((moved <= TOLERANCE * reach) & (turned <= TOLERANCE * scale)).sum())
