"""The scale tool: two points on an object of known length convert scene units to metres."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ...engine.errors import FruitLangsError
from ...engine.report.words import format_three_digits, length_unit
from ..blender_data import find_owned_object, find_owned_objects
from ..data.write_fruits import MEASURED, set_unit
from ..data.write_root import METRES
from ..jobs.jobs import is_busy, is_linked
from ..root_placement import place_root, placement_of, root_frame, upright_of
from ..settings.settings import read_config
from .pick_tool import PickTool


def scale_text(bpy_scene: bpy.types.Scene) -> str:
    """'1 scene unit is 0.998 m'; empty if the scale is unknown."""
    root = find_owned_object(bpy_scene, "root")
    return f"1 scene unit is {format_three_digits(root[METRES])} m" if root is not None and root.get(METRES) else ""


def rescale(bpy_scene: bpy.types.Scene, metres_per_unit: float) -> None:
    """Apply the scale to everything in this Blender scene: the root, the lengths of fruit, the clipping of cameras, the
    panel.

    The next count gets it from the settings.
    """
    frame = root_frame(bpy_scene)
    if frame is None:
        return
    before = float(frame.root.get(METRES) or 0.0)
    ratio = metres_per_unit / (before or 1.0)
    place_root(frame, Matrix.Scale(ratio, 4) @ upright_of(frame), placement_of(frame))
    frame.root[METRES] = metres_per_unit
    for item in find_owned_objects(bpy_scene, "fruit"):
        for key in (key for key in MEASURED if key in item):
            item[key] = item[key] * ratio
        set_unit(item, metres_per_unit)
    for item in find_owned_objects(bpy_scene, "camera"):
        item.data.clip_start *= ratio
        item.data.clip_end *= ratio
    shown = bpy_scene.fruitlangs.result
    if shown.count >= 0:
        old = length_unit(before or None)[1]
        shown.unit, new = length_unit(metres_per_unit)
        shown.mean_diameter *= new / old


def set_length(settings: Any, points: NDArray[np.float64], length: float) -> None:
    """Make a length in metres between two points (2, 3) the only measurement in the settings."""
    units = settings.config.units
    for name in ("cameras", "object"):
        units.property_unset(name)
    units.metres_per_unit = 0.0
    units.points = points.ravel().tolist()
    units.length = length


class FRUITLANGS_OT_measure(PickTool, bpy.types.Operator):
    bl_idname = "fruitlangs.measure"
    bl_label = "Measure Length"
    bl_description = "Set the scale by clicking on both ends of an object of known length"

    asks = ("click on one end of a known length", "click on its other end")

    def handle_points(self, context: bpy.types.Context, points: NDArray[np.float64]) -> set[str]:
        bpy.ops.fruitlangs.set_length("INVOKE_DEFAULT", points=points.ravel().tolist())
        return {"FINISHED"}


class FRUITLANGS_OT_set_length(bpy.types.Operator):
    bl_idname = "fruitlangs.set_length"
    bl_label = "Set Length"
    bl_description = "Set the distance in metres between two points of the scene"
    bl_options = {"REGISTER", "UNDO"}

    points: bpy.props.FloatVectorProperty(
        name="Points", size=6, precision=4, description="Positions x y z of both ends in the scene frame"
    )
    length: bpy.props.FloatProperty(
        name="Length in m", default=1.0, min=1e-4, soft_max=100.0, precision=3, description="Measured length in metres"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context):
            return False
        if context.scene is None or find_owned_object(context.scene, "root") is None:
            cls.poll_message_set("Import a scene first")
            return False
        return True

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context: bpy.types.Context) -> None:
        self.layout.prop(self, "length")

    def execute(self, context: bpy.types.Context) -> set[str]:
        from ...engine.scene.scale import scale_by_length

        settings = context.scene.fruitlangs
        ends = np.array(self.points, np.float64).reshape(2, 3)
        if np.allclose(ends[0], ends[1]):
            self.report({"ERROR"}, "Both points are the same. Pick the two ends of an object")
            return {"CANCELLED"}
        set_length(settings, ends, self.length)
        try:
            scale = scale_by_length(read_config(settings).units, [], [])
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        assert scale is not None
        rescale(context.scene, scale.metres_per_unit)
        self.report({"INFO"}, scale_text(context.scene))
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_measure, FRUITLANGS_OT_set_length)
