"""The 3D viewport's sidebar tab "Fruit"."""

from __future__ import annotations

import textwrap
from typing import Any

import bpy

from ..operators.count import FRUITLANGS_OT_count, size_text
from ..operators.dependencies import FRUITLANGS_OT_copy_install_command, missing_packages
from ..operators.import_scene import FRUITLANGS_OT_import_scene
from ..operators.jobs import FRUITLANGS_OT_cancel, Job, running
from .properties import STAGES

MAIN_SETTINGS = (("scene", "downscale"), ("train", "steps"), ("train", "max_gaussians"), ("count", "threshold"))
"""The settings most people change; the others fold out below."""


class SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Fruit"


class FRUITLANGS_PT_count(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_count"
    bl_label = "Count Fruit"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        settings = context.scene.fruitlangs
        missing = missing_packages()
        if missing:
            draw_missing(layout, missing, context)
        column = layout.column()
        column.enabled = running() is None
        column.prop(settings, "source")
        column.operator(FRUITLANGS_OT_import_scene.bl_idname, icon="IMPORT")
        result = settings.result
        if result.cameras:
            column.label(text=f"{result.cameras} cameras, {result.points} points", icon="CAMERA_DATA")
        column.separator()
        column.prop(settings, "prompt")
        column.prop(settings, "negative")
        column.prop(settings, "out")
        column.separator()
        column.prop(settings, "preset")
        for stage, name in MAIN_SETTINGS:
            column.prop(getattr(settings.config, stage), name)
        draw_action(layout, running())
        draw_result(layout, settings, context)


class FRUITLANGS_PT_settings(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_settings"
    bl_label = "All Settings"
    bl_parent_id = "FRUITLANGS_PT_count"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.enabled = running() is None
        for stage in STAGES:
            group = getattr(context.scene.fruitlangs.config, stage)
            layout.label(text={"embed": "Language"}.get(stage, stage.capitalize()))
            column = layout.column(align=True)
            for name in STAGES[stage].__annotations__:
                column.prop(group, name)


def draw_missing(layout: Any, missing: list[str], context: bpy.types.Context) -> None:
    """What to install before anything can run."""
    box = layout.box()
    box.label(text="Python packages are missing", icon="ERROR")
    draw_text(box, ", ".join(missing), context)
    box.operator(FRUITLANGS_OT_copy_install_command.bl_idname, icon="COPYDOWN")
    draw_text(box, "Run it in a terminal, then restart Blender.", context)


def draw_action(layout: Any, job: Job | None) -> None:
    """The button that counts; while a job runs, how far it is and the button that stops it."""
    if job is None:
        row = layout.row()
        row.scale_y = 1.5
        row.operator(FRUITLANGS_OT_count.bl_idname, icon="VIEWZOOM")
        return
    column = layout.column()
    message = "stopping" if job.cancelling else job.message
    column.progress(factor=job.fraction, text=f"{job.title} {job.fraction:.0%}")
    column.label(text=f"{message} ({job.seconds:.0f} s)")
    column.operator(FRUITLANGS_OT_cancel.bl_idname, icon="CANCEL")


def draw_result(layout: Any, settings: Any, context: bpy.types.Context) -> None:
    """The last count, or what went wrong."""
    if settings.error:
        box = layout.box()
        box.alert = True
        box.label(text="It did not work", icon="ERROR")
        draw_text(box, settings.error, context)
        return
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
            draw_text(box, "Scale unknown: a Length under Units makes millimetres of it", context)
        draw_text(box, result.sureness, context)
        draw_text(box, result.whereabouts, context)
    else:
        draw_text(box, result.zero_reason, context)
    if result.notices:
        draw_text(box, result.notices, context)
    draw_text(box, result.folder, context)


def draw_text(layout: Any, text: str, context: bpy.types.Context) -> None:
    """Text broken to the sidebar's width; labels do not wrap by themselves."""
    pixels = context.region.width / context.preferences.system.ui_scale
    column = layout.column(align=True)
    for line in textwrap.wrap(text, max(int(pixels / 6.3) - 6, 12)):
        column.label(text=line)


CLASSES = (FRUITLANGS_PT_count, FRUITLANGS_PT_settings)
