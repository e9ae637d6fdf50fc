"""Appearance of the Gaussians, a panel below step 3 because the highlight shows the effect of a prompt."""

from __future__ import annotations

import bpy

from ...operators.blender_data import find_owned_object
from .panel_parts import SidebarPanel, draw_splat_problem
from .step_ask import FRUITLANGS_PT_ask


class FRUITLANGS_PT_look(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_look"
    bl_label = "Appearance"
    bl_parent_id = FRUITLANGS_PT_ask.bl_idname
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.scene is not None and find_owned_object(context.scene, "gaussians") is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.layout, context.scene.fruitlangs
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(settings.look, "style")
        draw_splat_problem(layout, context)
        layout.prop(settings.look, "highlight")
        column = layout.column()
        column.enabled = settings.look.highlight
        column.prop(settings.config.count, "threshold", slider=True)
        column.prop(settings.look, "dimming", slider=True)
        layout.prop(settings.look, "fruit")


CLASSES = (FRUITLANGS_PT_look,)
