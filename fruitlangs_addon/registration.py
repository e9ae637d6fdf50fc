"""The list of classes, and everything else that registering adds to Blender."""

from __future__ import annotations

from typing import Any

import bpy

from ..operators import package_folder
from ..operators.block import block
from ..operators.drawing import label_drawing, legend, splat_drawing
from ..operators.export import export
from ..operators.jobs import active_tool, jobs
from ..operators.packages import caches, dependencies
from ..operators.photos import best_photo, photo_backgrounds
from ..operators.review import missing, review, show_cluster
from ..operators.settings import moved_paths, region
from ..operators.steps import ask, check_photos, count, import_scene, open_stored, reconstruct, teach
from ..operators.tools import level, reset_placement, scale
from ..operators.viewport import appearance
from . import preferences, properties
from .panels import (
    appearance_panel,
    block_panel,
    fruit_list,
    step_ask,
    step_count,
    step_export,
    step_reconstruct,
    step_review,
    step_scene,
    teach_panel,
)

CLASSES: tuple[Any, ...] = (
    *properties.CLASSES,
    *jobs.CLASSES,
    *dependencies.CLASSES,
    *caches.CLASSES,
    *import_scene.CLASSES,
    *check_photos.CLASSES,
    *scale.CLASSES,
    *level.CLASSES,
    *reset_placement.CLASSES,
    *region.CLASSES,
    *reconstruct.CLASSES,
    *ask.CLASSES,
    *teach.CLASSES,
    *count.CLASSES,
    *review.CLASSES,
    *missing.CLASSES,
    *show_cluster.CLASSES,
    *best_photo.CLASSES,
    *export.CLASSES,
    *block.CLASSES,
    *step_scene.CLASSES,
    *step_reconstruct.CLASSES,
    *step_ask.CLASSES,
    *teach_panel.CLASSES,
    *appearance_panel.CLASSES,
    *step_count.CLASSES,
    *fruit_list.CLASSES,
    *step_review.CLASSES,
    *step_export.CLASSES,
    *block_panel.CLASSES,
    *preferences.CLASSES,
)

CANCEL_SECONDS = 5.0
"""Seconds that disabling waits for a job to stop."""


def register() -> None:
    """Register everything; a second call first unregisters the first one's."""
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
    appearance.register_handlers()
    moved_paths.register_handlers()
    open_stored.register_handlers()
    splat_drawing.register_handlers()


def unregister() -> None:
    """Unregister everything; a tool that waits for clicks ends, and a running job is asked to stop."""
    active_tool.end_waiting()
    jobs.release_job(CANCEL_SECONDS)
    splat_drawing.unregister_handlers()
    open_stored.unregister_handlers()
    moved_paths.unregister_handlers()
    appearance.unregister_handlers()
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
