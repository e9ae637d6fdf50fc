"""Shows a photo's camera in a viewport, and restores the previous view."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..data.photo_files import ASPECT, SIZE
from ..data.write_cameras import show_through
from ..viewport.viewport import find_screens

SHOWN = 0.12
"""Least width of a fruit, in heights of the viewport."""


def find_view_area(context: bpy.types.Context) -> bpy.types.Area | None:
    """Find the 3D viewport whose button was pressed, else the first of the screen; None in background mode."""
    if bpy.app.background:
        return None
    if context.area is not None and context.area.type == "VIEW_3D":
        return context.area
    areas = (area for screen in find_screens(context, context.scene) for area in screen.areas)
    return next((area for area in areas if area.type == "VIEW_3D"), None)


def has_stored_view(bpy_scene: bpy.types.Scene) -> bool:
    """Whether there is a view to return to."""
    return bool(bpy_scene.fruitlangs.photos.perspective)


def look_through(
    context: bpy.types.Context, camera: bpy.types.Object, place: NDArray[np.float64], pixels: float
) -> None:
    """Show a camera of ours in the viewport, centred on the object at pixel `place` (2,) of its photo that is `pixels`
    wide.

    The previous view is stored in the .blend until `restore_view`.
    """
    area, bpy_scene = find_view_area(context), context.scene
    view = None if area is None else area.spaces.active.region_3d
    if not has_stored_view(bpy_scene) or (view is not None and view.view_perspective != "CAMERA"):
        _remember(bpy_scene, view)
    show_through(bpy_scene, camera)
    if area is None or view is None:
        return
    area.spaces.active.use_local_camera = False
    view.view_perspective = "CAMERA"
    _frame(area, camera, place, pixels)


def _frame(area: bpy.types.Area, camera: bpy.types.Object, place: NDArray[np.float64], pixels: float) -> None:
    """Move and zoom the photo so that the object is centred in the region next to the sidebar.

    Blender draws the frame `zoom` times as wide as the region, and shifts it by twice the offset times `zoom` regions.
    """
    regions = {region.type: region for region in area.regions}
    window, view = regions["WINDOW"], area.spaces.active.region_3d
    covered = regions["UI"].width if area.spaces.active.show_region_ui else 0
    width, height, (columns, rows), ratio = window.width, window.height, camera[SIZE], camera[ASPECT]
    shape = rows * ratio / columns  # the frame's height by its width
    whole = min((width - covered) / width, height / (width * shape))
    zoom = max(whole, SHOWN * min(width, height) / (width * pixels / columns))
    view.view_camera_zoom = float(np.clip(50.0 * (2.0 * np.sqrt(zoom) - np.sqrt(2.0)), -30.0, 600.0))
    across, upward = place[0] / columns - 0.5, 0.5 - place[1] / rows
    view.view_camera_offset = (
        float(np.clip(0.5 * across + 0.25 * covered / (width * zoom), -1.0, 1.0)),
        float(np.clip(0.5 * upward * shape * width / height, -1.0, 1.0)),
    )


def restore_view(context: bpy.types.Context) -> None:
    """Restore the view before the first photo, and the scene's own camera and size."""
    area, photos = find_view_area(context), context.scene.fruitlangs.photos
    if not has_stored_view(context.scene):
        if area is not None:
            area.spaces.active.region_3d.view_perspective = "PERSP"
        return
    if area is not None:
        view = area.spaces.active.region_3d
        view.view_perspective = photos.perspective
        if photos.perspective != "CAMERA":
            view.view_location, view.view_rotation = photos.location, photos.rotation
            view.view_distance = photos.distance
    render = context.scene.render
    if photos.camera is not None:  # a count in the meantime replaces the cameras of photos
        context.scene.camera = photos.camera
    render.resolution_x, render.resolution_y, render.resolution_percentage = photos.resolution
    render.pixel_aspect_x, render.pixel_aspect_y = photos.aspect
    photos.perspective = ""


def _remember(bpy_scene: bpy.types.Scene, view: Any) -> None:
    """Store the view of a viewport, and the scene's camera and size, which a photo replaces."""
    photos, render = bpy_scene.fruitlangs.photos, bpy_scene.render
    if not has_stored_view(bpy_scene):  # otherwise a photo's camera is shown already, and the previous view is stored
        photos.camera = bpy_scene.camera
        photos.resolution = (render.resolution_x, render.resolution_y, render.resolution_percentage)
        photos.aspect = (render.pixel_aspect_x, render.pixel_aspect_y)
    photos.perspective = "PERSP" if view is None else view.view_perspective
    if view is not None:
        photos.location, photos.rotation = view.view_location, view.view_rotation
        photos.distance = view.view_distance
