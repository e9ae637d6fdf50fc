"""Where the user put the tree: a change of the root relative to the upright matrix that the extension gave it.

The upright matrix maps the scene frame to metres (or scene units) with the ground at height 0. A new scale, ground or
count replaces it; the user's placement stays on top until the user resets it. Up, sizes and exports use the upright
matrix, so they do not depend on the placement.
"""

from __future__ import annotations

import math

import bpy
import numpy as np
from mathutils import Matrix, Quaternion

from ..engine.errors import SceneError
from .blender_data import find_owned_object
from .scene_frame import SceneFrame, scene_frame

UPRIGHT = "fruitlangs_upright"
"""Custom property of the root: the upright matrix, 16 numbers in rows."""
UNMOVED = 1e-5
"""Largest relative difference from the upright matrix without a placement: the object stores float32."""


def root_frame(bpy_scene: bpy.types.Scene) -> SceneFrame | None:
    """The scene frame; the root's own if the objects below it were moved apart; None without a root."""
    root = find_owned_object(bpy_scene, "root")
    if root is None:
        return None
    try:
        return scene_frame(bpy_scene)
    except SceneError:
        return SceneFrame(root, Matrix())


def upright_of(frame: SceneFrame) -> Matrix:
    """(4, 4) from the scene frame to the upright one; in a file of an earlier version the root's matrix."""
    stored = frame.root.get(UPRIGHT)
    return _find_in_parent(frame) if stored is None else Matrix(np.reshape(stored, (4, 4)).tolist())


def placement_of(frame: SceneFrame) -> Matrix | None:
    """(4, 4) how the user moved, rotated and scaled the upright tree; None if it is where the extension put it."""
    placed, upright = (np.array(matrix, np.float64) for matrix in (_find_in_parent(frame), upright_of(frame)))
    away = np.abs(placed - upright)
    scale = np.abs(upright[:3, :3]).max()
    reach = max(np.abs(upright[:3, 3]).max(), scale)
    if away[:3, :3].max() <= UNMOVED * scale and away[:3, 3].max() <= UNMOVED * reach:
        return None
    return Matrix(placed.tolist()) @ Matrix(upright.tolist()).inverted()


def read_placement(bpy_scene: bpy.types.Scene) -> Matrix | None:
    """Return `placement_of` the root of this Blender scene; None without a root."""
    root = find_owned_object(bpy_scene, "root")
    if root is None or placement_of(SceneFrame(root, Matrix())) is None:  # the usual case, which a panel needs often
        return None
    frame = root_frame(bpy_scene)
    return None if frame is None else placement_of(frame)


def place_root(frame: SceneFrame, upright: Matrix, placement: Matrix | None) -> None:
    """Give the root an upright matrix with the user's placement on top; the root stays untouched if neither changes."""
    root, numbers = frame.root, [value for row in upright for value in row]
    if placement == placement_of(frame) and list(root.get(UPRIGHT, ())) == numbers:
        return
    placed = upright if placement is None else placement @ upright
    root.matrix_basis = placed if frame.in_root == Matrix() else placed @ frame.in_root.inverted()
    root[UPRIGHT] = numbers


def remove_tilt(placement: Matrix | None) -> Matrix | None:
    """Return a placement that leaves the ground level and at its height: its position on the ground, heading and
    scale."""
    if placement is None:
        return None
    place, turned, scale = placement.decompose()
    heading = Quaternion((turned.w, 0.0, 0.0, turned.z))
    place.z = 0.0
    return Matrix.LocRotScale(place, heading.normalized() if heading.magnitude > 0.0 else Quaternion(), scale)


def placement_text(placement: Matrix) -> str:
    """'moved, rotated, 100 times as large': what a placement does."""
    place, turned, scale = placement.decompose()
    size = float(abs(placement.to_3x3().determinant()) ** (1.0 / 3.0))
    parts = ["moved"] if place.length > UNMOVED else []
    parts += ["rotated"] if min(turned.angle, 2.0 * math.pi - turned.angle) > UNMOVED else []
    if max(abs(side / scale.x - 1.0) for side in scale) > UNMOVED:
        parts.append("stretched")
    if abs(size - 1.0) > UNMOVED:
        parts.append(f"{size:.3g} times as large")
    return ", ".join(parts) or "moved"


def _find_in_parent(frame: SceneFrame) -> Matrix:
    """Return the transform (4, 4) from the scene frame to that of the root's parent, or to the world without one."""
    return frame.root.matrix_basis @ frame.in_root
