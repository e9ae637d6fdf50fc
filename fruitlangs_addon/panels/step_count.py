"""Step 4, Count: the count with its intervals, or the error."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.data.read_gaussians import count_deleted_gaussians
from ...operators.steps.count import FRUITLANGS_OT_count
from ...operators.steps.show_result import size_text
from .panel_parts import StepPanel, draw_job, draw_text
from .settings_panels import make_settings_panels

DELETED = "Deleted Gaussians ({:,}) take part in a count and come back. To leave out a part, add a region in step 1"


class FRUITLANGS_PT_count(StepPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_count"
    bl_label = "4 Count"
    bl_order = 4
    step = "count"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.make_body(context), context.scene.fruitlangs
        deleted = count_deleted_gaussians(context.scene)
        if deleted:
            draw_text(layout, DELETED.format(deleted), context, icon="INFO")
        if not draw_job(layout, FRUITLANGS_OT_count.title, context):
            row = layout.row()
            row.scale_y = 1.5
            row.operator(FRUITLANGS_OT_count.bl_idname, icon="VIEWZOOM")
        draw_result(layout, settings, context)


def draw_result(layout: Any, settings: Any, context: bpy.types.Context) -> None:
    """Draw the last count."""
    result = settings.result
    if result.count < 0:
        return
    box = layout.box()
    row = box.row()
    row.scale_y = 1.4
    row.label(text=f"{result.label}: {result.count}", icon="CHECKMARK")
    if result.count:
        box.label(text=size_text(result).capitalize())
        if result.unit != "mm":
            draw_text(box, "Scale unknown. Use Measure Length (step 1) to get millimetres", context)
        draw_text(box, result.sureness, context)
        draw_text(box, result.whereabouts, context)
    else:
        draw_text(box, result.zero_reason, context)
    if result.notices:
        draw_text(box, result.notices, context)
    draw_text(box, result.folder, context)


SETTINGS = make_settings_panels(FRUITLANGS_PT_count, ("count",))

CLASSES = (FRUITLANGS_PT_count, *SETTINGS)
