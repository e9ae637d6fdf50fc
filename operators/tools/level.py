"""Sets ground and up from three picked points on the ground."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
import numpy as np
from mathutils import Matrix, Vector
from numpy.typing import NDArray

from ...engine.errors import FruitLangsError
from ..blender_data import find_owned_object, find_owned_objects
from ..data.write_root import GROUND
from ..root_placement import place_root, placement_of, remove_tilt, upright_of
from ..scene_frame import SceneFrame, scene_frame
from ..settings.region import stand_upright
from ..viewport.viewport import find_screens, look_at_scene
from .pick_tool import PickTool

LEAST_SINE = 0.02
"""Least sine of the angle between two sides of the picked triangle that defines a plane."""


def find_plane_up(points: NDArray[np.float64], above: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Find the unit normal (3,) of the plane through points (3, 3), on the side of `above` (3,); None for a line."""
    first, second = points[1] - points[0], points[2] - points[0]
    normal = np.cross(first, second)
    size = np.linalg.norm(first) * np.linalg.norm(second)
    if size == 0.0 or np.linalg.norm(normal) < LEAST_SINE * size:
        return None
    normal /= np.linalg.norm(normal)
    return normal if normal @ (above - points[0]) >= 0.0 else -normal


class FRUITLANGS_OT_set_ground(PickTool, bpy.types.Operator):
    bl_idname = "fruitlangs.set_ground"
    bl_label = "Set Ground"
    bl_description = "Level the scene by clicking on three distant points of the ground"
    bl_options = {"REGISTER", "UNDO"}

    asks = (
        "click on the ground",
        "click on the ground farther away",
        "click on the ground, not in line with both",
    )

    points: bpy.props.FloatVectorProperty(
        name="Points",
        size=9,
        precision=4,
        options={"SKIP_SAVE"},
        description="Positions x y z of three points on the ground",
    )

    def handle_points(self, context: bpy.types.Context, points: NDArray[np.float64]) -> set[str]:
        self.points = points.ravel().tolist()
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        bpy_scene = context.scene
        try:
            frame = scene_frame(bpy_scene)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        points = np.array(self.points, np.float64).reshape(3, 3)
        cameras = find_owned_objects(bpy_scene, "camera")
        above = np.mean([frame.of(item).translation for item in cameras], axis=0) if cameras else points[0]
        up = find_plane_up(points, above)
        if up is None:
            self.report({"ERROR"}, "The three points lie on a line. Click on three points that form a triangle")
            return {"CANCELLED"}
        bpy_scene.fruitlangs.config.scene.up = up.tolist()
        bpy_scene[GROUND] = points.mean(axis=0).tolist()
        box = find_owned_object(bpy_scene, "region")
        place = None if box is None else frame.of(box).translation
        level(frame, up, points.mean(axis=0))
        if box is not None and place is not None:
            stand_upright(box, frame, upright_of(frame) @ place, box.matrix_basis.to_scale())
        look_at_scene(find_screens(context, bpy_scene), bpy_scene)
        self.report({"INFO"}, "The ground is level, at height 0. The next count uses it")
        return {"FINISHED"}


def level(frame: SceneFrame, up: NDArray[np.float64], ground: NDArray[np.float64]) -> None:
    """Rotate the root so that `up` (3,) points to +Z and the point `ground` (3,) of the scene is at height 0.

    The position on the ground, the heading and the scale that the user gave stay.
    """
    upright = upright_of(frame)
    turned = upright.to_3x3() @ Vector(up.tolist())
    upright = turned.rotation_difference(Vector((0.0, 0.0, 1.0))).to_matrix().to_4x4() @ upright
    height = (upright @ Vector(ground.tolist())).z
    upright = Matrix.Translation((0.0, 0.0, -height)) @ upright
    place_root(frame, upright, remove_tilt(placement_of(frame)))


CLASSES = (FRUITLANGS_OT_set_ground,)
