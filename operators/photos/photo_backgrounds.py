"""Photos behind their cameras: loaded when a camera is viewed, removed after the next one.

Hundreds of photos of 20 megapixels do not fit into memory, so an import loads none. Viewing through a camera, by our
buttons or Blender's own keys, is detected when a viewport is drawn. A photo of a lens with distortion is undistorted in
a thread, so that the window stays responsive.
"""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..blender_data import OWNER, areas_of
from ..data.photo_files import find_ready_file, has_photo, prepare_undistortion, provide_viewed_file, remove_backgrounds
from ..jobs.jobs import describe_error
from ..settings.settings import PHOTO_PROBLEM, format_stored_path
from ..viewport.viewport import Drawing, has_window, redraw_viewports

PROBLEM = PHOTO_PROBLEM
WAIT = 0.1
"""Seconds between two checks whether a photo is undistorted."""

# Undistortion belongs to this session, not to the .blend: {session id of a camera: its photo in progress}.
_in_work: dict[int, Future[None]] = {}
_worker: ThreadPoolExecutor | None = None


def show_photo(item: bpy.types.Object) -> None:
    """Put the photo of a camera of ours behind it, unless it is there.

    In a window, a photo that must be undistorted appears when that is done (`is_awaited`); otherwise this waits for it.

    Raises:
        SceneError: the photo is gone or cannot be decoded.
    """
    if PROBLEM in item:
        del item[PROBLEM]
    if background_of(item) is None:
        file = _request_file(item) if has_window() else provide_viewed_file(item)
        if file is None:
            return
        remove_backgrounds([item])
        image = bpy.data.images.load(format_stored_path(file))
        image[OWNER] = "photo"
        slot = item.data.background_images.new()
        slot.image, slot.frame_method, slot.display_depth = image, "STRETCH", "FRONT"
    item.data.show_background_images = True
    fade(item)


def is_awaited(item: bpy.types.Object) -> bool:
    """Whether the photo of a camera is being undistorted."""
    return item.session_uid in _in_work


def _request_file(item: bpy.types.Object) -> Path | None:
    """Return the picture of a camera; None while a thread makes it.

    Raises:
        SceneError: the photo is gone, or the thread could not decode it.
    """
    global _worker
    work = _in_work.get(item.session_uid)
    if work is not None:
        if not work.done():
            return None
        del _in_work[item.session_uid]
        work.result()
    file = find_ready_file(item)
    if file is None:
        if _worker is None:
            _worker = ThreadPoolExecutor(1, "fruitlangs-photo")
        _in_work[item.session_uid] = _worker.submit(prepare_undistortion(item))
        _show_soon()
    return file


def background_of(item: bpy.types.Object) -> Any:
    """The background of ours on a camera; None without one, or if the file of its picture is gone."""
    for slot in item.data.background_images:
        if slot.image is not None and slot.image.get(OWNER) == "photo":
            return slot if Path(bpy.path.abspath(slot.image.filepath)).is_file() else None
    return None


def keep_only(items: Iterable[bpy.types.Object]) -> None:
    """Remove our photos from all cameras but these."""
    kept = set(items)
    remove_backgrounds([item for item in bpy.data.objects if has_photo(item) and item not in kept])


def fade(item: bpy.types.Object) -> None:
    """Show a camera's photo with the opacity in the settings of its scene."""
    photos = _settings(item)
    slot = background_of(item)
    if slot is not None and photos is not None:
        slot.alpha, slot.show_background_image = photos.opacity, photos.show


def apply_opacity(photos: Any, _context: Any = None) -> None:
    """Called when the opacity of photos was edited."""
    for item in photos.id_data.objects:
        if has_photo(item):
            fade(item)


def _settings(item: bpy.types.Object) -> Any:
    scene = next((scene for scene in bpy.data.scenes if item.name in scene.objects), None)
    return None if scene is None or not hasattr(scene, "fruitlangs") else scene.fruitlangs.photos


def photo_cover(space: Any, view: Any, bpy_scene: bpy.types.Scene) -> float:
    """Opacity of the photo over the reconstruction in a viewport, 0 to 1; 0 if none is shown."""
    item = _camera_of(space, view, bpy_scene)
    slot = None if item is None or not item.data.show_background_images else background_of(item)
    return float(slot.alpha) if slot is not None and slot.show_background_image else 0.0


def find_viewed_cameras() -> list[bpy.types.Object]:
    """Find the cameras of ours that the viewports of all windows show."""
    found = [
        _camera_of(area.spaces.active, area.spaces.active.region_3d, window.scene)
        for window, area in areas_of(bpy.context, "VIEW_3D")
    ]
    return [item for item in dict.fromkeys(found) if item is not None]


def _camera_of(space: Any, view: Any, bpy_scene: bpy.types.Scene) -> bpy.types.Object | None:
    if view is None or view.view_perspective != "CAMERA":
        return None
    item = space.camera if space.use_local_camera else bpy_scene.camera
    return item if has_photo(item) else None


def _watch() -> None:
    """Called when a viewport is drawn, during which the .blend must not change."""
    context = bpy.context
    if context.space_data is None or context.region_data is None:
        return
    item = _camera_of(context.space_data, context.region_data, context.scene)
    if item is None or PROBLEM in item or background_of(item) is not None:
        return
    _show_soon()


def _show_soon() -> None:
    if not bpy.app.timers.is_registered(_show_viewed):
        bpy.app.timers.register(_show_viewed, first_interval=0.0)


def _show_viewed() -> float | None:
    """Show the photos of the viewed cameras; the panel shows why one is missing."""
    items, before = find_viewed_cameras(), set(_in_work)
    if items:
        keep_only(items)
    _forget_work(items)
    for item in items:
        try:
            show_photo(item)
        except Exception as error:
            item[PROBLEM] = describe_error(error)
    if not _in_work or set(_in_work) != before:
        redraw_viewports()
    return WAIT if _in_work else None


def _forget_work(items: Iterable[bpy.types.Object]) -> None:
    """Cancel photos in progress for cameras other than these."""
    wanted = {item.session_uid for item in items}
    for uid in set(_in_work) - wanted:
        _in_work.pop(uid).cancel()


@persistent
def _forget_problems(_file: Any = None, _unused: Any = None) -> None:
    """After loading: a photo that was missing when the file was saved may be back."""
    for item in bpy.data.objects:
        if PROBLEM in item:
            del item[PROBLEM]


_drawing = Drawing(_watch, "POST_PIXEL")


def register_watch() -> None:
    """Detect viewed cameras; not in background mode."""
    _drawing.start()
    bpy.app.handlers.load_post.append(_forget_problems)


def unregister_watch() -> None:
    """Take back what `register_watch` added."""
    global _worker
    _drawing.stop()
    if _forget_problems in bpy.app.handlers.load_post:
        bpy.app.handlers.load_post.remove(_forget_problems)
    if bpy.app.timers.is_registered(_show_viewed):
        bpy.app.timers.unregister(_show_viewed)
    _forget_work([])
    if _worker is not None:
        _worker.shutdown(wait=False)
        _worker = None
