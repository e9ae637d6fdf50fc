"""What to do with fruit that are missing: restore them, or reject them."""

from __future__ import annotations

from typing import Any

import bpy

from ..blender_data import find_owned_objects
from ..data.fruit_objects import REJECTED, REVIEW, fruit_frame, spot_of
from ..data.manual_edits import log_copies, remember_fruit
from ..data.missing_fruit import (
    DELETED,
    count_many_missing,
    describe_rejected,
    reject_missing,
    reopen_rejected,
    restore_missing,
)
from ..jobs.jobs import describe_error, is_busy, is_editing
from .review import has_root


class MissingFruit:
    """Mix-in of operators that decide what becomes of missing fruit."""

    def execute(self: Any, context: bpy.types.Context) -> set[str]:
        try:
            log_copies(context.scene)
            done = self.decide(context.scene)
            remember_fruit(context.scene)
        except Exception as error:
            self.report({"ERROR"}, describe_error(error))
            return {"CANCELLED"}
        self.report({"INFO"}, done)
        return {"FINISHED"}


class FRUITLANGS_OT_restore_fruit(MissingFruit, bpy.types.Operator):
    bl_idname = "fruitlangs.restore_fruit"
    bl_label = "Restore Fruit"
    bl_description = "Bring back fruit that were deleted or unlinked, or else all rejected ones"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_editing(cls, context) or not has_root(cls, context):
            return False
        if not count_many_missing(context.scene) and not describe_rejected(context.scene):
            cls.poll_message_set("Most fruit are there")
            return False
        return True

    def decide(self, bpy_scene: bpy.types.Scene) -> str:
        if count_many_missing(bpy_scene):
            return f"{restore_missing(bpy_scene)} fruit are back"
        frame, fruits = fruit_frame(bpy_scene), find_owned_objects(bpy_scene, "fruit")
        rejected = [spot_of(item, frame) for item in fruits if item.get(REVIEW) == REJECTED]
        return f"{reopen_rejected(bpy_scene, rejected)} fruit are back"


class FRUITLANGS_OT_reject_missing(MissingFruit, bpy.types.Operator):
    bl_idname = "fruitlangs.reject_missing"
    bl_label = "Reject Missing"
    bl_description = "Reject the fruit that were deleted or unlinked, so that they are not counted"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or not has_root(cls, context):
            return False
        if not count_many_missing(context.scene):
            cls.poll_message_set("No fruit are missing")
            return False
        return True

    def decide(self, bpy_scene: bpy.types.Scene) -> str:
        review = bpy_scene.fruitlangs.review
        reason, review.reason = review.reason.strip() or DELETED, ""
        return f"{len(reject_missing(bpy_scene, reason))} fruit are rejected"


CLASSES = (FRUITLANGS_OT_restore_fruit, FRUITLANGS_OT_reject_missing)
