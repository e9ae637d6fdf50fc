"""Orchard: all trees of a block in one scene, and the review of each."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.block.block import (
    FRUITLANGS_OT_open_block,
    FRUITLANGS_OT_open_tree,
    FRUITLANGS_OT_show_block,
    FRUITLANGS_OT_update_block,
)
from .panel_parts import SidebarPanel, draw_job, draw_text


class FRUITLANGS_UL_trees(bpy.types.UIList):
    bl_idname = "FRUITLANGS_UL_trees"

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
        row = layout.split(factor=0.5, align=True)
        row.label(text=item.name, icon=icon_of(item))
        for text in cells(item):
            row.label(text=text)


def icon_of(item: Any) -> str:
    """An error without a count, an information if there is a note on it, a check mark after a review."""
    if item.counted < 0:
        return "ERROR"
    if item.note:
        return "INFO"
    return "CHECKMARK" if item.reviewed >= 0 else "BLANK1"


def cells(item: Any) -> list[str]:
    """The count of a tree before and after its review."""
    if item.counted < 0:
        return [item.problem]
    return [str(item.counted), "" if item.reviewed < 0 else str(item.reviewed)]


class FRUITLANGS_PT_block(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_block"
    bl_label = "Orchard"
    bl_order = 7

    def draw(self, context: bpy.types.Context) -> None:
        layout, block = self.layout, context.scene.fruitlangs.block
        if FRUITLANGS_OT_show_block.poll(context):
            draw_text(layout, "Review this tree in step 5, then go back and update the tables", context, icon="INFO")
            layout.operator(FRUITLANGS_OT_show_block.bl_idname, icon="LOOP_BACK")
            return
        layout.prop(block, "folder")
        for operator in (FRUITLANGS_OT_open_block, FRUITLANGS_OT_update_block):
            if draw_job(layout, operator.title, context):
                return
        layout.operator(FRUITLANGS_OT_open_block.bl_idname, icon="FILE_FOLDER")
        if not block.trees:
            return
        row = layout.split(factor=0.5, align=True)
        for text in ("Tree", "Counted", "Reviewed"):
            row.label(text=text)
        layout.template_list(FRUITLANGS_UL_trees.bl_idname, "", block, "trees", block, "active", rows=6)
        tree = block.trees[block.active] if 0 <= block.active < len(block.trees) else None
        if tree is not None and (tree.problem or tree.note):
            draw_text(layout, f"{tree.name}: {tree.problem or tree.note}", context, icon=icon_of(tree))
        layout.operator(FRUITLANGS_OT_open_tree.bl_idname, icon="ZOOM_IN")
        layout.operator(FRUITLANGS_OT_update_block.bl_idname, icon="FILE_REFRESH")
        layout.prop(block, "colors", expand=True)


CLASSES = (FRUITLANGS_UL_trees, FRUITLANGS_PT_block)
