"""Shows a .blend that the command line wrote as Import Scene would show its result."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..data.fruit_objects import LAST_ID
from ..data.manual_edits import remember_fruit
from ..settings.panel_state import STORED, PanelState, read_stored_panel, show_state
from ..viewport.viewport import has_window
from .ask import show_answer_text


@persistent
def show_stored(_file: Any = None, _unused: Any = None) -> None:
    """After loading: move what the command line stored into the properties of the extension."""
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.library is None and hasattr(bpy_scene, "fruitlangs"):
            state = read_stored_panel(bpy_scene)
            if state is not None:
                show_panel(bpy_scene, state)
                del bpy_scene[STORED]


def show_panel(bpy_scene: bpy.types.Scene, state: PanelState) -> None:
    """Set the properties of a Blender scene, and remember its fruit for the review."""
    settings = bpy_scene.fruitlangs
    settings.prompt, settings.negative = state.prompt, state.negative
    settings.config.count.threshold = state.threshold
    settings.source = state.chosen
    for part in (state.scene, state.gaussians, state.count):
        show_state(settings.result, part)
    settings.result.source, settings.result.mark = state.source, state.mark
    bpy_scene[LAST_ID] = max(int(bpy_scene.get(LAST_ID, 0)), state.last_id)
    remember_fruit(bpy_scene)
    show_answer_text(bpy_scene)


def register_handlers() -> None:
    """Watch loading; a file that is open already follows when the extension is registered."""
    bpy.app.handlers.load_post.append(show_stored)
    if has_window():  # the .blend must not change while an extension is registered
        bpy.app.timers.register(show_stored, first_interval=0.0)
    elif hasattr(bpy.data, "scenes"):
        show_stored()


def unregister_handlers() -> None:
    """Take back what `register_handlers` added."""
    if bpy.app.timers.is_registered(show_stored):
        bpy.app.timers.unregister(show_stored)
    if show_stored in bpy.app.handlers.load_post:
        bpy.app.handlers.load_post.remove(show_stored)
