"""The one list of classes, and what registering adds to Blender beside them."""

from __future__ import annotations

from typing import Any

import bpy

from ..operators import (
    ask,
    best_photo,
    caches,
    count,
    dependencies,
    export,
    import_scene,
    jobs,
    label_drawing,
    legend,
    level,
    look,
    look_at_cluster,
    moved_paths,
    package_folder,
    photo_backgrounds,
    reconstruct,
    region,
    review,
    scale,
    splat_drawing,
    waiting_tool,
)
from . import (
    fruit_list,
    look_panel,
    preferences,
    properties,
    step_ask,
    step_count,
    step_export,
    step_reconstruct,
    step_review,
    step_scene,
)

CLASSES: tuple[Any, ...] = (
    *properties.CLASSES,
    *jobs.CLASSES,
    *dependencies.CLASSES,
    *caches.CLASSES,
    *import_scene.CLASSES,
    *scale.CLASSES,
    *level.CLASSES,
    *region.CLASSES,
    *reconstruct.CLASSES,
    *ask.CLASSES,
    *count.CLASSES,
    *review.CLASSES,
    *look_at_cluster.CLASSES,
    *best_photo.CLASSES,
    *export.CLASSES,
    *step_scene.CLASSES,
    *step_reconstruct.CLASSES,
    *step_ask.CLASSES,
    *look_panel.CLASSES,
    *step_count.CLASSES,
    *fruit_list.CLASSES,
    *step_review.CLASSES,
    *step_export.CLASSES,
    *preferences.CLASSES,
)

CANCEL_SECONDS = 5.0
"""How long disabling waits for a job to stop."""


def register() -> None:
    """Add everything; a second call first takes the first one's away."""
    if hasattr(bpy.types.Scene, "fruitlangs"):
        unregister()
    package_folder.use_packages()
    for item in CLASSES:
        bpy.utils.register_class(item)
    bpy.types.Scene.fruitlangs = bpy.props.PointerProperty(type=properties.FRUITLANGS_PG_settings)
    bpy.types.TOPBAR_MT_file_import.append(import_scene.menu_entry)
    bpy.types.TOPBAR_MT_file_export.append(export.menu_entry)
    ask.register_handlers()
    photo_backgrounds.register_watch()
    label_drawing.drawing.start()
    legend.drawing.start()
    look.register_handlers()
    moved_paths.register_handlers()
    splat_drawing.register_handlers()


def unregister() -> None:
    """Take everything away and leave nothing behind; what waits for clicks ends, a running job is asked to stop."""
    waiting_tool.end_waiting()
    jobs.let_go(CANCEL_SECONDS)
    splat_drawing.unregister_handlers()
    moved_paths.unregister_handlers()
    look.unregister_handlers()
    legend.drawing.stop()
    label_drawing.drawing.stop()
    photo_backgrounds.unregister_watch()
    ask.unregister_handlers()
    bpy.types.TOPBAR_MT_file_export.remove(export.menu_entry)
    bpy.types.TOPBAR_MT_file_import.remove(import_scene.menu_entry)
    if hasattr(bpy.types.Scene, "fruitlangs"):
        del bpy.types.Scene.fruitlangs
    for item in reversed(CLASSES):
        if item.is_registered:
            bpy.utils.unregister_class(item)
    package_folder.forget_packages()
