"""The sparse cloud as a Blender point object."""

from __future__ import annotations

from contextlib import suppress
from typing import TYPE_CHECKING

import bpy

from ..blender_data import (
    linear_from_srgb,
    new_object,
    owned_collection,
    owned_objects,
    point_mesh,
    remove_objects,
    rgba,
    set_attribute,
)
from ..viewport.gaussian_nodes import point_node_group, set_input

if TYPE_CHECKING:
    from ...engine.scene.camera import Scene

RADIUS = 0.003
"""Radius of a point, as a share of the scene's extent."""


def write_points(bpy_scene: bpy.types.Scene, scene: Scene, root: bpy.types.Object) -> bpy.types.Object:
    """Replace this Blender scene's sparse cloud: a mesh of points with their linear colour in `radiance:base`."""
    remove_objects(owned_objects(bpy_scene, "points"))
    mesh = point_mesh("Sparse points", scene.points)
    set_attribute(mesh, "radiance:base", "FLOAT_COLOR", rgba(linear_from_srgb(scene.colors / 255.0)))
    mesh.update()
    item = new_object("Sparse points", mesh, "points", owned_collection(bpy_scene, "scene", "FruitLangs"), root)
    modifier = item.modifiers.new("Points", "NODES")
    modifier.node_group = point_node_group()
    set_input(modifier, "Radius", RADIUS * scene.extent if len(scene.cameras) else RADIUS)
    return item


def hide_points(bpy_scene: bpy.types.Scene) -> None:
    """Hide the sparse cloud in viewport and renders, because Gaussians show the same."""
    for item in owned_objects(bpy_scene, "points"):
        item.hide_render = True
        for view_layer in bpy_scene.view_layers:
            with suppress(RuntimeError):  # this view layer excludes it
                item.hide_set(True, view_layer=view_layer)
