"""The settings that fold out below a step, generated from the engine's configs."""

from __future__ import annotations

from collections.abc import Sequence

import bpy

from ...operators.jobs.jobs import running
from ..properties import STAGES
from .panel_parts import SidebarPanel, draw_settings

HEADINGS = {"scene": "Photos", "photos": "Finding cameras", "embed": "Language", "count": "Counting"}


def settings_panel(parent: type, stages: Sequence[str]) -> type:
    """A panel, closed at first, with every setting of these stages below the step `parent`."""

    def draw(self: bpy.types.Panel, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.enabled = running() is None
        for stage in stages:
            if len(stages) > 1:
                layout.label(text=HEADINGS.get(stage, stage.capitalize()))
            draw_settings(layout, getattr(context.scene.fruitlangs.config, stage), STAGES[stage].__annotations__)

    name = f"{parent.__name__}_settings"
    content = {
        "__doc__": settings_panel.__doc__,
        "__module__": __name__,
        "bl_idname": name,
        "bl_label": "Settings",
        "bl_parent_id": parent.__name__,
        "bl_options": {"DEFAULT_CLOSED"},
        "draw": draw,
    }
    return type(name, (SidebarPanel, bpy.types.Panel), content)
