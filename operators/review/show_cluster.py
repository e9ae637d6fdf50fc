"""Shows a cluster of the audit, for example a dropped one."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from mathutils import Vector

from ...engine.report.words import place
from ..blender_data import owned_object
from ..data.stored_audit import read_audit
from ..data.write_root import world_scale
from ..viewport.viewport import look_at_point, shown_screens
from .review import CLOSE, has_root, usual_diameter


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
        center = cluster_center(context.scene, self.cluster)
        if center is None:
            self.report({"WARNING"}, f"The audit of this count has no position for cluster {self.cluster}")
            return {"CANCELLED"}
        look_at_point(shown_screens(context, context.scene), center, CLOSE * usual_size(context.scene))
        return {"FINISHED"}


def cluster_center(bpy_scene: bpy.types.Scene, cluster: int) -> Vector | None:
    """The position of the cluster with that number in the world; None if the audit has none."""
    root = owned_object(bpy_scene, "root")
    centers = [place(entry) for entry in read_audit(bpy_scene) if entry.cluster == cluster]
    return None if root is None or not centers or centers[0] is None else root.matrix_world @ Vector(centers[0])


def usual_size(bpy_scene: bpy.types.Scene) -> float:
    """The diameter of fruit in the world; without fruit, an estimate from the size of the scene."""
    root = owned_object(bpy_scene, "root")
    assert root is not None
    return (usual_diameter(bpy_scene) or 0.5 * root.empty_display_size) * world_scale(root)


CLASSES = (FRUITLANGS_OT_look_at_cluster,)
