"""The buttons that show the active fruit in its photos."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.photos.best_photo import FRUITLANGS_OT_best_photo, FRUITLANGS_OT_free_view, FRUITLANGS_OT_next_photo
from ...operators.photos.photo_backgrounds import PROBLEM, is_awaited
from .panel_parts import draw_text


def draw_photos(layout: Any, context: bpy.types.Context) -> None:
    """Draw the buttons that show the active fruit in its photos, and the opacity of the photo."""
    photos, camera = context.scene.fruitlangs.photos, context.scene.camera
    column = layout.column(align=True)
    row = column.row(align=True)
    row.operator(FRUITLANGS_OT_best_photo.bl_idname, icon="CAMERA_DATA")
    row.operator(FRUITLANGS_OT_next_photo.bl_idname, icon="TRIA_LEFT", text="").step = -1
    row.operator(FRUITLANGS_OT_next_photo.bl_idname, icon="TRIA_RIGHT", text="").step = 1
    if FRUITLANGS_OT_free_view.poll(context):
        column.operator(FRUITLANGS_OT_free_view.bl_idname, icon="LOOP_BACK")
        row = column.row(align=True)
        row.prop(photos, "show", text="", icon="HIDE_OFF" if photos.show else "HIDE_ON")
        slider = row.row(align=True)
        slider.active = photos.show
        slider.prop(photos, "opacity", slider=True)
    if camera is not None and is_awaited(camera):
        layout.label(text="Undistorting the photo", icon="TIME")
    if camera is not None and PROBLEM in camera:
        draw_text(layout, camera[PROBLEM], context, icon="ERROR")
