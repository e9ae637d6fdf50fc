"""The one list of classes, and what registering adds to Blender beside them."""

from __future__ import annotations

from typing import Any

import bpy

from ..operators import count, dependencies, import_scene, jobs
from . import panels, preferences, properties

CLASSES: tuple[Any, ...] = (
    *properties.CLASSES,
    *jobs.CLASSES,
    *dependencies.CLASSES,
    *import_scene.CLASSES,
    *count.CLASSES,
    *panels.CLASSES,
    *preferences.CLASSES,
)

CANCEL_SECONDS = 5.0
"""How long disabling waits for a job to stop."""


def register() -> None:
    """Add everything; a second call first takes the first one's away."""
    if hasattr(bpy.types.Scene, "fruitlangs"):
        unregister()
    for item in CLASSES:
        bpy.utils.register_class(item)
    bpy.types.Scene.fruitlangs = bpy.props.PointerProperty(type=properties.FRUITLANGS_PG_settings)
    bpy.types.TOPBAR_MT_file_import.append(import_scene.menu_entry)


def unregister() -> None:
    """Take everything away and leave nothing behind; a running job is asked to stop."""
    jobs.cancel_running(CANCEL_SECONDS)
    bpy.types.TOPBAR_MT_file_import.remove(import_scene.menu_entry)
    if hasattr(bpy.types.Scene, "fruitlangs"):
        del bpy.types.Scene.fruitlangs
    for item in reversed(CLASSES):
        if item.is_registered:
            bpy.utils.unregister_class(item)
