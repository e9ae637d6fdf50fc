"""Position and axes of a fruit object, wherever its size is stored.

The writers put the size of a fruit into the object's scale, and its mesh is a sphere of diameter 1. Apply Transform
moves the size into the mesh. So both are measured together: the second moments of the vertices of a scaled sphere give
its half axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import CountingError
from ..scene_frame import SceneFrame

FloatArray = NDArray[np.float64]

ROUNDNESS = 0.02
"""Largest relative distance of a vertex from the ellipsoid of a mesh that is one."""
SAME_SHAPE = 1e-5
"""Largest difference from the sphere that is written, in its diameters."""
UNIT_SPHERE = 0.5 * np.eye(3)
"""Half axes of the mesh that is written."""
ORTHOGONAL = 1e-5
"""Largest cosine between two axes that are the principal ones."""


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """center: (3,); axes: (3, 3), rows are the half axes, longest first, right-handed."""

    center: FloatArray
    axes: FloatArray


def fruit_ellipsoid(item: bpy.types.Object, frame: SceneFrame) -> Ellipsoid:
    """The ellipsoid of a fruit object, in the scene frame and units.

    Raises:
        CountingError: its mesh was edited and is no ellipsoid.
        SceneError: the scene frame is unknown.
    """
    placed = np.array(frame.of(item), np.float64)
    mesh = _mesh_ellipsoid(item)
    axes = _find_principal_axes(mesh.axes @ placed[:3, :3].T)
    axes = axes[np.argsort(-np.linalg.norm(axes, axis=1), kind="stable")]
    axes[2] *= np.sign(np.linalg.det(axes)) or 1.0
    return Ellipsoid(placed[:3, :3] @ mesh.center + placed[:3, 3], axes)


def is_unit_sphere(item: bpy.types.Object) -> bool:
    """Whether the mesh of a fruit object is the sphere of the writers, so that its size is in the object alone."""
    try:
        mesh = _mesh_ellipsoid(item)
    except CountingError:
        return False
    return not mesh.center.any() and bool((mesh.axes == UNIT_SPHERE).all())


def _mesh_ellipsoid(item: bpy.types.Object) -> Ellipsoid:
    """The ellipsoid of a fruit's mesh, in the object's own coordinates; axes in no order."""
    vertices = np.empty(3 * len(item.data.vertices), np.float32)
    item.data.vertices.foreach_get("co", vertices)
    points = vertices.reshape(-1, 3).astype(np.float64)
    center = points.mean(axis=0) if len(points) else np.zeros(3)
    around = points - center
    # Vertices spread evenly over a sphere of radius r have the second moments r² / 3.
    shape = 3.0 * around.T @ around / max(len(points), 1)
    if max(np.abs(shape - UNIT_SPHERE**2).max(), np.abs(center).max()) <= SAME_SHAPE:
        return Ellipsoid(np.zeros(3), UNIT_SPHERE)
    variances, directions = np.linalg.eigh(shape)
    axes = np.sqrt(variances.clip(0.0))[:, None] * directions.T
    if variances[0] > 0.0:
        away = np.linalg.norm((around @ directions) / np.sqrt(variances), axis=1)
        if np.abs(away - 1.0).max() <= ROUNDNESS:
            return Ellipsoid(center, axes)
    raise CountingError(
        f"The mesh of {item.name} was edited and is not an ellipsoid, so its size is unknown. Undo that, or delete it "
        "(X) and add a fruit"
    )


def _find_principal_axes(axes: FloatArray) -> FloatArray:
    """Find the half axes (3, 3) of the ellipsoid that the rows of `axes` (3, 3) map the unit sphere to."""
    lengths = np.linalg.norm(axes, axis=1)
    cosines = np.abs(axes @ axes.T - np.diag(lengths**2)).max()
    if cosines <= ORTHOGONAL * lengths.max() ** 2:
        return axes.copy()
    _, sizes, directions = np.linalg.svd(axes)
    return sizes[:, None] * directions
