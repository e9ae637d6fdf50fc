"""Puts the tree back where the extension put it, after the user moved, rotated or scaled its root."""

from __future__ import annotations

import bpy

from ..jobs.jobs import is_busy, is_linked
from ..root_placement import place_root, read_placement, root_frame, upright_of


class FRUITLANGS_OT_reset_placement(bpy.types.Operator):
    bl_idname = "fruitlangs.reset_placement"
    bl_label = "Reset Placement"
    bl_description = "Put the tree back: upright over the origin, at its own size"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context):
            return False
        if context.scene is None or read_placement(context.scene) is None:
            cls.poll_message_set("The tree is where it was imported")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> set[str]:
        frame = root_frame(context.scene)
        assert frame is not None
        place_root(frame, upright_of(frame), None)
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_reset_placement,)
