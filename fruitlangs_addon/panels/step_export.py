"""Step 6, Export: the reviewed fruit as files for people and for other programs."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.data.read_fruits import has_count
from ...operators.data.stored_review import review_line
from ...operators.export.export import NAMES, FRUITLANGS_OT_export_csv
from ...operators.export.export_file import TITLE
from ...operators.export.export_pictures import FRUITLANGS_OT_export_report, FRUITLANGS_OT_export_still
from ...operators.export.export_usd import WITHOUT, has_usd
from .panel_parts import StepPanel, draw_job, draw_text

ICONS: dict[Any, str] = {
    FRUITLANGS_OT_export_report: "FILE_TEXT",
    FRUITLANGS_OT_export_still: "IMAGE_DATA",
    FRUITLANGS_OT_export_csv: "SPREADSHEET",
}
"""Exports for people; the others are for programs."""


class FRUITLANGS_PT_export(StepPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_export"
    bl_label = "6 Export"
    bl_order = 6
    step = "export"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.make_body(context)
        if draw_job(layout, TITLE, context):
            return
        if has_count(context.scene):
            draw_text(layout, review_line(context.scene).capitalize(), context, icon="CHECKMARK")
        for item, icon in ICONS.items():
            layout.operator(item.bl_idname, text=NAMES[item], icon=icon)
        grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
        for item, text in NAMES.items():
            if item not in ICONS:
                grid.operator(item.bl_idname, text=text, icon="EXPORT")
        if not has_usd():
            draw_text(layout, f"{WITHOUT}; use glTF", context, icon="INFO")


CLASSES = (FRUITLANGS_PT_export,)
