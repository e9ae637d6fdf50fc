"""The sparse cloud as a Blender point object."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING, Any

import bpy
from numpy.typing import NDArray

from ..blender_data import (
    adopt,
    ensure_owned_collection,
    find_original,
    find_owned_objects,
    linear_from_srgb,
    make_object,
    make_point_mesh,
    replace_mesh,
    rgba,
    set_attribute,
)
from ..viewport.gaussian_nodes import point_node_group, set_input

if TYPE_CHECKING:
    from ...engine.scene.camera import Scene

RADIUS = 0.003
"""Radius of a point, as a share of the scene's extent."""


def write_points(bpy_scene: bpy.types.Scene, scene: Scene, root: bpy.types.Object) -> bpy.types.Object:
    """Create this Blender scene's sparse cloud, points with their linear colour in `radiance:base`, or replace the mesh
    of the existing one."""
    own = find_original(find_owned_objects(bpy_scene, "points"))
    mesh = make_colored_points("Sparse points", scene.points, scene.colors / 255.0)
    if own is not None:
        adopt(own, root)
        replace_mesh(own, mesh)
        return own
    item = make_object("Sparse points", mesh, "points", ensure_owned_collection(bpy_scene, "scene", "FruitLangs"), root)
    show_points(item, RADIUS * scene.extent if len(scene.cameras) else RADIUS)
    return item


def make_colored_points(name: str, positions: NDArray[Any], srgb: NDArray[Any]) -> bpy.types.Mesh:
    """Make a mesh of points at positions (N, 3) with their linear colour in `radiance:base`; srgb: (N, 3), 0 to 1."""
    mesh = make_point_mesh(name, positions)
    set_attribute(mesh, "radiance:base", "FLOAT_COLOR", rgba(linear_from_srgb(srgb)))
    mesh.update()
    return mesh


def show_points(item: bpy.types.Object, radius: float) -> None:
    """Show the points of an object with this radius, in its own units."""
    modifier = item.modifiers.new("Points", "NODES")
    modifier.node_group = point_node_group()
    set_input(modifier, "Radius", radius)


def hide_points(bpy_scene: bpy.types.Scene) -> None:
    """Hide the sparse cloud in viewport and renders, because Gaussians show the same."""
    for item in find_owned_objects(bpy_scene, "points"):
        item.hide_render = True
        for view_layer in bpy_scene.view_layers:
            with suppress(RuntimeError):  # this view layer excludes it
                item.hide_set(True, view_layer=view_layer)
