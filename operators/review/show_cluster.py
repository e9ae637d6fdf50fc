"""Shows a cluster of the audit, for example a dropped one."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from mathutils import Vector

from ...engine.errors import FruitLangsError
from ...engine.report.words import place
from ..data.fruit_objects import find_usual_diameter
from ..data.stored_audit import read_audit
from ..scene_frame import scene_frame
from ..viewport.viewport import find_screens, look_at_point
from .review import CLOSE, has_root


class FRUITLANGS_OT_look_at_cluster(bpy.types.Operator):
    bl_idname = "fruitlangs.look_at_cluster"
    bl_label = "Show Cluster"
    bl_description = "Center the viewport on this cluster of points"

    cluster: bpy.props.IntProperty(
        name="Cluster", options={"SKIP_SAVE"}, description="Number of the cluster in the audit"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene is not None and has_root(cls, context)

    def execute(self, context: bpy.types.Context) -> set[str]:
        try:
            center = find_cluster_center(context.scene, self.cluster)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if center is None:
            self.report({"WARNING"}, f"The audit of this count has no position for cluster {self.cluster}")
            return {"CANCELLED"}
        look_at_point(find_screens(context, context.scene), center, CLOSE * find_usual_size(context.scene))
        return {"FINISHED"}


def find_cluster_center(bpy_scene: bpy.types.Scene, cluster: int) -> Vector | None:
    """Find the position of the cluster with that number in the world; None if the audit has none.

    Raises:
        SceneError: the scene frame is unknown.
    """
    centers = [place(entry) for entry in read_audit(bpy_scene) if entry.cluster == cluster]
    if not centers or centers[0] is None:
        return None
    return scene_frame(bpy_scene).to_world @ Vector(centers[0])


def find_usual_size(bpy_scene: bpy.types.Scene) -> float:
    """Return the diameter of fruit in the world; without fruit, an estimate from the size of the scene."""
    frame = scene_frame(bpy_scene)
    return (find_usual_diameter(bpy_scene) or 0.5 * frame.root.empty_display_size) * frame.world_scale


CLASSES = (FRUITLANGS_OT_look_at_cluster,)
