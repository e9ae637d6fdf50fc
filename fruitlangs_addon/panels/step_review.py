"""Step 5, Review: the list of fruit, and the decisions of the user."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.data.fruit_objects import diameter_head, find_usual_diameter, fruit_collection, metres_per_unit
from ...operators.data.missing_fruit import describe_missing, describe_rejected
from ...operators.data.read_fruits import has_count
from ...operators.data.stored_review import entry_text, review_line
from ...operators.review.missing import FRUITLANGS_OT_reject_missing, FRUITLANGS_OT_restore_fruit
from ...operators.review.review import (
    FRUITLANGS_OT_add_fruit,
    FRUITLANGS_OT_confirm_fruit,
    FRUITLANGS_OT_merge_fruit,
    FRUITLANGS_OT_next_uncertain,
    FRUITLANGS_OT_reject_fruit,
    FRUITLANGS_OT_relabel_fruit,
    FRUITLANGS_OT_reopen_fruit,
    FRUITLANGS_OT_split_fruit,
)
from .audit_panel import FRUITLANGS_PT_review_why
from .fruit_list import FRUITLANGS_UL_fruits, draw_head
from .panel_parts import SidebarPanel, StepPanel, draw_text
from .photo_buttons import draw_photos

LAST = 8
"""Entries of the log that the panel shows."""


class FRUITLANGS_PT_review(StepPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_review"
    bl_label = "5 Review"
    bl_order = 5
    step = "review"

    def draw(self, context: bpy.types.Context) -> None:
        layout, review = self.make_body(context), context.scene.fruitlangs.review
        if not has_count(context.scene):
            return
        draw_text(layout, review_line(context.scene).capitalize(), context, icon="CHECKMARK")
        draw_missing(layout, context)
        draw_list(layout, context)
        row = layout.row(align=True)
        row.operator(FRUITLANGS_OT_confirm_fruit.bl_idname, icon="CHECKMARK")
        row.operator(FRUITLANGS_OT_reject_fruit.bl_idname, icon="X")
        row.operator(FRUITLANGS_OT_reopen_fruit.bl_idname, icon="LOOP_BACK", text="")
        row = layout.row(align=True)
        row.operator(FRUITLANGS_OT_merge_fruit.bl_idname, icon="AUTOMERGE_ON")
        row.operator(FRUITLANGS_OT_add_fruit.bl_idname, icon="ADD")
        if not find_usual_diameter(context.scene):
            metric = metres_per_unit(context.scene) is not None
            layout.prop(review, "diameter_mm" if metric else "diameter", text=diameter_head(metric))
        row = layout.row(align=True)
        row.operator(FRUITLANGS_OT_split_fruit.bl_idname, icon="MOD_EXPLODE")
        row.prop(review, "parts", text="")
        row = layout.row(align=True)
        row.operator(FRUITLANGS_OT_relabel_fruit.bl_idname, icon="FILE_TEXT")
        row.prop(review, "label", text="")
        layout.prop(review, "reason")


def draw_missing(layout: Any, context: bpy.types.Context) -> None:
    """Draw what to do about many fruit that were deleted, unlinked or rejected; nothing otherwise."""
    missing = describe_missing(context.scene)
    text = missing or describe_rejected(context.scene)
    if not text:
        return
    box = layout.box()
    box.alert = bool(missing)
    draw_text(box, text[0].upper() + text[1:], context, icon="ERROR")
    box.operator(FRUITLANGS_OT_restore_fruit.bl_idname, icon="LOOP_BACK")
    if missing:
        box.operator(FRUITLANGS_OT_reject_missing.bl_idname, icon="X")


def draw_list(layout: Any, context: bpy.types.Context) -> None:
    """Draw the list of fruit and the ways to view them; nothing without fruit."""
    review, collection = context.scene.fruitlangs.review, fruit_collection(context.scene)
    if collection is None:
        return
    layout.prop(review, "show")
    if review.show == "DOUBTFUL":
        layout.prop(review, "doubt", slider=True)
    layout.prop(review, "sort")
    draw_head(layout, context)
    layout.template_list(FRUITLANGS_UL_fruits.bl_idname, "", collection, "objects", review, "active_fruit", rows=6)
    layout.operator(FRUITLANGS_OT_next_uncertain.bl_idname, icon="VIEWZOOM")
    draw_photos(layout, context)
    layout.prop(review, "labels")


class FRUITLANGS_PT_review_log(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_review_log"
    bl_label = "Log"
    bl_parent_id = "FRUITLANGS_PT_review"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        log = context.scene.fruitlangs.review.log
        if not len(log):
            self.layout.label(text="No decisions yet")
        for entry in list(log)[: -LAST - 1 : -1]:
            draw_text(self.layout, entry_text(entry), context)
        if len(log) > LAST:
            self.layout.label(text=f"… and {len(log) - LAST} earlier")


CLASSES = (FRUITLANGS_PT_review, FRUITLANGS_PT_review_why, FRUITLANGS_PT_review_log)
