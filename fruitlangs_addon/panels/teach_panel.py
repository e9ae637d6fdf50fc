"""Teach Word, a part of step 3: the name of a word, its examples, and Save Word."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.jobs.jobs import find_running_job
from ...operators.steps.teach import (
    FRUITLANGS_OT_add_examples,
    FRUITLANGS_OT_add_reviewed,
    FRUITLANGS_OT_look_at_example,
    FRUITLANGS_OT_remove_example,
    FRUITLANGS_OT_save_word,
)
from .panel_parts import SidebarPanel, draw_text


class FRUITLANGS_UL_examples(bpy.types.UIList):
    bl_idname = "FRUITLANGS_UL_examples"

    def draw_item(
        self,
        context: bpy.types.Context,
        layout: Any,
        data: Any,
        item: Any,
        icon: int,
        active_data: Any,
        active_property: str,
        index: int = 0,
        flt_flag: int = 0,
    ) -> None:
        row = layout.row(align=True)
        sign = "ADD" if item.positive else "REMOVE"
        row.label(text=f"{index + 1} {item.source}", icon=sign)
        row.prop(item, "positive", text="")


class FRUITLANGS_PT_teach(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_teach"
    bl_label = "Teach Word"
    bl_parent_id = "FRUITLANGS_PT_ask"

    def draw(self, context: bpy.types.Context) -> None:
        layout, teach = self.layout, context.scene.fruitlangs.teach
        layout.use_property_split = True
        layout.use_property_decorate = False
        column = layout.column()
        column.enabled = find_running_job() is None
        column.prop(teach, "word")
        if not teach.word.strip():
            return
        row = column.row(align=True)
        row.operator(FRUITLANGS_OT_add_examples.bl_idname, icon="RESTRICT_SELECT_OFF")
        row.operator(FRUITLANGS_OT_add_reviewed.bl_idname, icon="CHECKMARK")
        if len(teach.examples):
            row = column.row()
            row.template_list(FRUITLANGS_UL_examples.bl_idname, "", teach, "examples", teach, "active", rows=4)
            side = row.column(align=True)
            side.operator(FRUITLANGS_OT_look_at_example.bl_idname, icon="VIEWZOOM", text="")
            side.operator(FRUITLANGS_OT_remove_example.bl_idname, icon="REMOVE", text="")
        column.operator(FRUITLANGS_OT_save_word.bl_idname, icon="FILE_TICK")
        if teach.saved:
            draw_text(layout, teach.saved, context, icon="CHECKMARK")


CLASSES = (FRUITLANGS_UL_examples, FRUITLANGS_PT_teach)
