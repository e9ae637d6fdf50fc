"""Step 3, Prompt: the words, and how many Gaussians match them."""

from __future__ import annotations

import bpy

from ...operators.jobs.jobs import find_running_job
from ...operators.steps.ask import FRUITLANGS_OT_ask
from .panel_parts import StepPanel, draw_text
from .settings_panels import make_settings_panels


class FRUITLANGS_PT_ask(StepPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_ask"
    bl_label = "3 Prompt"
    bl_order = 3
    step = "ask"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.make_body(context), context.scene.fruitlangs
        column = layout.column()
        column.enabled = find_running_job() is None
        column.prop(settings, "prompt")
        column.prop(settings, "negative")
        column.prop(settings.config.count, "threshold", slider=True)
        if settings.answer.problem:
            box = layout.box()
            box.alert = True
            draw_text(box, settings.answer.problem, context, icon="ERROR")
        elif settings.answer.text:
            draw_text(layout, settings.answer.text, context, icon="CHECKMARK")
        layout.operator(FRUITLANGS_OT_ask.bl_idname, icon="QUESTION")


SETTINGS = make_settings_panels(FRUITLANGS_PT_ask, ("embed",))

CLASSES = (FRUITLANGS_PT_ask, *SETTINGS)
