"""Photos behind their cameras: each is put there when somebody looks through its camera, and taken away after the next.

Hundreds of photos of 20 megapixels fit into no memory, so an import loads none. That a camera is looked through, by
our buttons or by Blender's own keys, is noticed when a viewport is drawn.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import bpy

from .blender_data import OWNER
from .jobs import describe_error
from .photo_files import has_photo, viewed_file
from .settings import stored_path
from .viewport import redraw_viewports

PROBLEM = "photo_problem"
"""Custom property of a camera: why its photo is not shown."""


def show_photo(item: bpy.types.Object) -> None:
    """Put the photo of a camera of ours behind it; nothing changes where it is there already.

    Raises:
        SceneError: the photo is gone or cannot be decoded.
    """
    if PROBLEM in item:
        del item[PROBLEM]
    if background_of(item) is None:
        remove_backgrounds([item])
        image = bpy.data.images.load(stored_path(viewed_file(item)))
        image[OWNER] = "photo"
        slot = item.data.background_images.new()
        slot.image, slot.frame_method, slot.display_depth = image, "STRETCH", "FRONT"
    item.data.show_background_images = True
    fade(item)


def background_of(item: bpy.types.Object) -> Any:
    """The background of ours that a camera has; None where it has none, or its picture's file is gone."""
    for slot in item.data.background_images:
        if slot.image is not None and slot.image.get(OWNER) == "photo":
            return slot if Path(bpy.path.abspath(slot.image.filepath)).is_file() else None
    return None


def remove_backgrounds(items: Iterable[bpy.types.Object]) -> None:
    """Take our photos from behind these cameras, and out of memory."""
    for item in items:
        slots = item.data.background_images
        for slot in [slot for slot in slots if slot.image is not None and slot.image.get(OWNER) == "photo"]:
            image, slot.image = slot.image, None  # removing the slot alone would leave its use of the picture counted
            slots.remove(slot)
            if image.users == 0:
                bpy.data.images.remove(image)


def keep_only(items: Iterable[bpy.types.Object]) -> None:
    """Take our photos from behind all cameras but these."""
    kept = set(items)
    remove_backgrounds([item for item in bpy.data.objects if has_photo(item) and item not in kept])


def fade(item: bpy.types.Object) -> None:
    """Show a camera's photo as strongly as its scene's settings say."""
    photos = _settings(item)
    slot = background_of(item)
    if slot is not None and photos is not None:
        slot.alpha, slot.show_background_image = photos.opacity, photos.show


def opacity_changed(photos: Any, _context: Any = None) -> None:
    """Called when the strength of photos was edited."""
    for item in photos.id_data.objects:
        if has_photo(item):
            fade(item)


def _settings(item: bpy.types.Object) -> Any:
    scene = next((scene for scene in bpy.data.scenes if item.name in scene.objects), None)
    return None if scene is None or not hasattr(scene, "fruitlangs") else scene.fruitlangs.photos


def photo_cover(space: Any, view: Any, bpy_scene: bpy.types.Scene) -> float:
    """How much of what is reconstructed the photo covers in a viewport, 0 to 1; 0 where none is shown."""
    item = _camera_of(space, view, bpy_scene)
    slot = None if item is None or not item.data.show_background_images else background_of(item)
    return float(slot.alpha) if slot is not None and slot.show_background_image else 0.0


def looked_through() -> list[bpy.types.Object]:
    """The cameras of ours that the viewports of all windows look through."""
    found = []
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                found.append(_camera_of(area.spaces.active, area.spaces.active.region_3d, window.scene))
    return [item for item in dict.fromkeys(found) if item is not None]


def _camera_of(space: Any, view: Any, bpy_scene: bpy.types.Scene) -> bpy.types.Object | None:
    if view is None or view.view_perspective != "CAMERA":
        return None
    item = space.camera if space.use_local_camera else bpy_scene.camera
    return item if has_photo(item) else None


def _watch() -> None:
    """Called when a viewport is drawn, in which nothing of the .blend may be changed."""
    context = bpy.context
    if context.space_data is None or context.region_data is None:
        return
    item = _camera_of(context.space_data, context.region_data, context.scene)
    if item is None or PROBLEM in item or background_of(item) is not None:
        return
    if not bpy.app.timers.is_registered(_show_looked_through):
        bpy.app.timers.register(_show_looked_through, first_interval=0.0)


def _show_looked_through() -> None:
    """Show the photos of the cameras that are looked through; why one is not shown stands in the panel."""
    items = looked_through()
    if items:
        keep_only(items)
    for item in items:
        try:
            show_photo(item)
        except Exception as error:
            item[PROBLEM] = describe_error(error)
    redraw_viewports()


# A drawing function cannot live in a .blend.
_handle: Any = None


def register_watch() -> None:
    """Notice cameras that are looked through; in background mode nobody looks."""
    global _handle
    if not bpy.app.background and _handle is None:
        _handle = bpy.types.SpaceView3D.draw_handler_add(_watch, (), "WINDOW", "POST_PIXEL")


def unregister_watch() -> None:
    """Take back what `register_watch` added."""
    global _handle
    if bpy.app.timers.is_registered(_show_looked_through):
        bpy.app.timers.unregister(_show_looked_through)
    if _handle is not None:
        bpy.types.SpaceView3D.draw_handler_remove(_handle, "WINDOW")
        _handle = None
