"""Step 1, Scene: the photos or the reconstruction, and information about them."""

from __future__ import annotations

from typing import Any

import bpy

from ...engine.scene.video.frames import VIDEO_SUFFIXES
from ...operators.blender_data import find_owned_object
from ...operators.jobs.jobs import find_running_job
from ...operators.root_placement import placement_text, read_placement
from ...operators.settings.region import FRUITLANGS_OT_add_region, FRUITLANGS_OT_remove_region
from ...operators.settings.settings import is_on_another_drive
from ...operators.steps.check_photos import FRUITLANGS_OT_check_photos, FRUITLANGS_OT_show_sheet
from ...operators.steps.import_scene import FRUITLANGS_OT_import_scene
from ...operators.tools.level import FRUITLANGS_OT_set_ground
from ...operators.tools.reset_placement import FRUITLANGS_OT_reset_placement
from ...operators.tools.scale import FRUITLANGS_OT_measure, scale_text
from .missing_packages import draw_missing_packages
from .panel_parts import StepPanel, draw_job, draw_text
from .settings_panels import make_settings_panels

VIDEOS = tuple(VIDEO_SUFFIXES)
ANOTHER_DRIVE = "The scene is on another drive than the .blend. Keep it where it is, or choose it again after moving it"


class FRUITLANGS_PT_scene(StepPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_scene"
    bl_label = "1 Scene"
    bl_order = 1
    step = "scene"

    def draw(self, context: bpy.types.Context) -> None:
        layout, settings = self.make_body(context), context.scene.fruitlangs
        draw_missing_packages(layout, context)
        column = layout.column()
        column.enabled = find_running_job() is None
        column.prop(settings, "source")
        if settings.source.lower().endswith(VIDEOS):
            column.label(text="Video: Import Scene chooses stills", icon="FILE_MOVIE")
        if not draw_job(layout, FRUITLANGS_OT_import_scene.title, context):
            layout.operator(FRUITLANGS_OT_import_scene.bl_idname, icon="IMPORT")
        if is_on_another_drive(settings.source):
            draw_text(layout, ANOTHER_DRIVE, context, icon="INFO")
        draw_check(layout, context)
        result = settings.result
        if result.cameras:
            points = f", {result.points:,} points" if result.points else ""
            layout.label(text=f"{result.cameras} cameras{points}", icon="CAMERA_DATA")
            draw_tools(layout, context)
            draw_placement(layout, context)
        if result.notices and not result.gaussians and result.count < 0:  # later steps show them with their results
            draw_text(layout, result.notices, context, icon="INFO")


def draw_check(layout: Any, context: bpy.types.Context) -> None:
    """Draw the button of the photo check, and what it found in the chosen scene."""
    settings = context.scene.fruitlangs
    if draw_job(layout, FRUITLANGS_OT_check_photos.title, context):
        return
    layout.operator(FRUITLANGS_OT_check_photos.bl_idname, icon="VIEWZOOM")
    check = settings.check
    if not check.summary or bpy.path.abspath(check.source) != bpy.path.abspath(settings.source).rstrip("/\\"):
        return
    draw_text(layout, check.summary, context, icon="ERROR" if any(each.problem for each in check.findings) else "INFO")
    for finding in check.findings:
        draw_text(layout, finding.text, context, icon="ERROR" if finding.problem else "DOT")
    layout.operator(FRUITLANGS_OT_show_sheet.bl_idname, icon="IMAGE_DATA")


def draw_tools(layout: Any, context: bpy.types.Context) -> None:
    """Draw the tools for scale, ground and region."""
    column = layout.column(align=True)
    column.operator(FRUITLANGS_OT_measure.bl_idname, icon="DRIVER_DISTANCE")
    column.operator(FRUITLANGS_OT_set_ground.bl_idname, icon="GRID")
    if find_owned_object(context.scene, "region") is None:
        column.operator(FRUITLANGS_OT_add_region.bl_idname, icon="CUBE")
    else:
        column.operator(FRUITLANGS_OT_remove_region.bl_idname, icon="X")
    layout.label(text=scale_text(context.scene) or "Scale unknown: sizes are in scene units")


def draw_placement(layout: Any, context: bpy.types.Context) -> None:
    """Draw how the user moved the tree, and the button that puts it back."""
    placement = read_placement(context.scene)
    if placement is not None:
        draw_text(layout, f"Placed by you: {placement_text(placement)}. Sizes and exports do not change", context)
        layout.operator(FRUITLANGS_OT_reset_placement.bl_idname, icon="LOOP_BACK")


SETTINGS = make_settings_panels(FRUITLANGS_PT_scene, ("scene", "photos", "units"))

CLASSES = (FRUITLANGS_PT_scene, *SETTINGS)
