"""The region of interest: an upright box in the viewport that limits a count.

The box is an ordinary object that the user moves, rotates about Z and scales; it is the truth, and the settings of
counting are read from it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...engine.errors import ConfigError
from ..blender_data import (
    ensure_owned_collection,
    find_owned_object,
    find_owned_objects,
    make_object,
    remove_objects,
    select_only,
)
from ..jobs.jobs import is_busy, is_linked
from ..root_placement import root_frame, upright_of
from ..scene_frame import SceneFrame, scene_frame

if TYPE_CHECKING:
    from ...engine.config import CountConfig

UPRIGHT = 0.9998
"""Least cosine between the box's own axis and up, about one degree."""
CORNERS = ((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0))


def limit_to_region(bpy_scene: bpy.types.Scene, config: CountConfig) -> CountConfig:
    """Return `config` limited to this Blender scene's box, as an outline with heights in the scene frame; unchanged
    without a box.

    Raises:
        ConfigError: the box is tilted or flat.
        SceneError: the scene frame is unknown.
    """
    box = find_owned_object(bpy_scene, "region")
    if box is None or find_owned_object(bpy_scene, "root") is None:
        return config
    frame = scene_frame(bpy_scene)
    up = np.array(upright_of(frame).to_3x3().row[2])
    up /= np.linalg.norm(up)
    placed = frame.of(box)
    axis = np.array(placed.to_3x3().col[2])
    size = min(column.length for column in placed.to_3x3().col)
    if size < 1e-9:
        raise ConfigError("The region box is flat. Scale it up, or remove it to count everywhere")
    if abs(axis @ up) < UPRIGHT * np.linalg.norm(axis):
        raise ConfigError(
            "The region box is tilted. Clear its rotation about X and Y, or remove it to count everywhere"
        )
    outline = tuple(float(value) for corner in CORNERS for value in placed @ Vector(corner))
    ends = sorted(float(up @ np.array(placed @ Vector((0, 0, end)))) for end in (-1, 1))
    return replace(config, box=None, polygon=outline, heights=(ends[0], ends[1]))


class FRUITLANGS_OT_add_region(bpy.types.Operator):
    bl_idname = "fruitlangs.add_region"
    bl_label = "Add Region"
    bl_description = "Add a box that limits counting; move it (G), rotate it about Z (R Z) or scale it (S)"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context):
            return False
        if context.scene is None or find_owned_object(context.scene, "root") is None:
            cls.poll_message_set("Import a scene first")
            return False
        if find_owned_object(context.scene, "region") is not None:
            cls.poll_message_set("There is a region box already")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        bpy_scene, frame = context.scene, root_frame(context.scene)
        assert frame is not None
        middle, half = find_surrounding_box(bpy_scene, frame)
        box = make_object(
            "Region", None, "region", ensure_owned_collection(bpy_scene, "scene", "FruitLangs"), frame.root
        )
        box.empty_display_type = "CUBE"
        stand_upright(box, frame, middle, half)
        if context.mode == "OBJECT":
            select_only(context, [box])
        self.report({"INFO"}, "The box limits counting. Move it with G, scale it with S, rotate it with R Z")
        return {"FINISHED"}


def stand_upright(box: bpy.types.Object, frame: SceneFrame, middle: Vector, half: Vector) -> None:
    """Place the box in the upright frame, with its side lengths in Blender's sidebar."""
    box.matrix_parent_inverse = frame.in_root @ upright_of(frame).inverted()
    box.matrix_basis = Matrix.LocRotScale(middle, box.matrix_basis.to_quaternion(), half)


def find_surrounding_box(bpy_scene: bpy.types.Scene, frame: SceneFrame) -> tuple[Vector, Vector]:
    """Find centre and half sides, in the upright frame, of a box around the fruit, else around what the cameras look
    at."""
    # From the set values, not evaluated ones: a new object has no matrix_world yet.
    upright = upright_of(frame)
    fruit = [upright @ frame.of(item) @ _find_middle(item) for item in find_owned_objects(bpy_scene, "fruit")]
    if len(fruit) > 1:
        low, high = (Vector(side(place[axis] for place in fruit) for axis in range(3)) for side in (min, max))
        return (low + high) / 2.0, (high - low) * 0.55 + Vector((1e-3, 1e-3, 1e-3)) * (high - low).length
    cameras = [(upright @ frame.of(item)).translation for item in find_owned_objects(bpy_scene, "camera")]
    reach = max((place.xy.length for place in cameras), default=2.0) / 2.0
    return Vector((0.0, 0.0, reach)), Vector((reach, reach, reach))


def _find_middle(item: bpy.types.Object) -> Vector:
    """Find the middle of the mesh of an object, in its own coordinates: not its origin after Apply Transform."""
    corners = [Vector(corner) for corner in item.bound_box]
    return sum(corners, Vector()) / len(corners)


class FRUITLANGS_OT_remove_region(bpy.types.Operator):
    bl_idname = "fruitlangs.remove_region"
    bl_label = "Remove Region"
    bl_description = "Remove the box, so that counting is not limited"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene is not None and find_owned_object(context.scene, "region") is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        remove_objects(find_owned_objects(context.scene, "region"))
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_add_region, FRUITLANGS_OT_remove_region)
