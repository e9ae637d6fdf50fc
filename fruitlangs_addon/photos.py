"""How photos are shown in the viewport, and what looking through one replaced."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import (
    BoolProperty,
    FloatProperty,
    FloatVectorProperty,
    IntVectorProperty,
    PointerProperty,
    StringProperty,
)

from ..operators.best_photo import FRUITLANGS_OT_best_photo, FRUITLANGS_OT_free_view, FRUITLANGS_OT_next_photo
from ..operators.photo_backgrounds import PROBLEM, is_awaited, opacity_changed
from .panel_parts import draw_text


class FRUITLANGS_PG_photos(bpy.types.PropertyGroup):
    """`scene.fruitlangs.photos`."""

    show: BoolProperty(
        name="Show Photo",
        default=True,
        update=opacity_changed,
        description="Show the photo when looking through its camera",
    )
    opacity: FloatProperty(
        name="Photo",
        default=0.7,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=opacity_changed,
        description="How strongly the photo covers what is reconstructed",
    )
    perspective: StringProperty(name="View", description="Of the free view; empty where no photo is looked through")
    location: FloatVectorProperty(name="Location", size=3, description="Of the free view")
    rotation: FloatVectorProperty(name="Rotation", size=4, description="Of the free view")
    distance: FloatProperty(name="Distance", description="Of the free view")
    camera: PointerProperty(type=bpy.types.Object, name="Camera", description="The scene's before photos")
    resolution: IntVectorProperty(name="Resolution", size=3, description="The scene's before photos")
    aspect: FloatVectorProperty(name="Aspect", size=2, description="The scene's pixel aspect before photos")


def draw_photos(layout: Any, context: bpy.types.Context) -> None:
    """The buttons that look at the active fruit in its photos, and how strongly a photo is shown."""
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
        layout.label(text="The photo is being undistorted", icon="TIME")
    if camera is not None and PROBLEM in camera:
        draw_text(layout, camera[PROBLEM], context, icon="ERROR")
