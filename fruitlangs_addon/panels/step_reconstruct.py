"""Step 2, Reconstruct: photos become Gaussians."""

from __future__ import annotations

import bpy

from ...operators.jobs.jobs import find_running_job
from ...operators.steps.device import describe_device
from ...operators.steps.reconstruct import FRUITLANGS_OT_reconstruct
from .panel_parts import StepPanel, draw_job, draw_settings, draw_splat_problem, draw_text
from .settings_panels import make_settings_panels

MAIN = ("steps", "max_gaussians")
"""The settings that most people change; the others are in the panels below."""


class FRUITLANGS_PT_reconstruct(StepPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_reconstruct"
    bl_label = "2 Reconstruct"
    bl_order = 2
    step = "reconstruct"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.make_body(context), context.scene.fruitlangs
        column = layout.column()
        column.enabled = find_running_job() is None
        column.prop(settings, "gaussians")
        if not settings.gaussians:
            column.prop(settings, "preset")
            column.prop(settings.config.scene, "downscale")
            draw_settings(column, settings.config.train, MAIN)
            draw_text(layout, describe_device(settings.config.train.device), context)
        column.prop(settings, "out")
        if not draw_job(layout, FRUITLANGS_OT_reconstruct.title, context):
            layout.operator(FRUITLANGS_OT_reconstruct.bl_idname, icon="OUTLINER_OB_POINTCLOUD")
        draw_splat_problem(layout, context)
        result = settings.result
        if result.gaussians:
            layout.label(text=f"{result.gaussians:,} Gaussians", icon="CHECKMARK")
            if result.quality:
                draw_text(layout, result.quality[:1].upper() + result.quality[1:], context)
            if result.notices and result.count < 0:  # after a count, step 4 shows them
                draw_text(layout, result.notices, context)


SETTINGS = make_settings_panels(FRUITLANGS_PT_reconstruct, ("train",))

CLASSES = (FRUITLANGS_PT_reconstruct, *SETTINGS)
