"""Appearance of Gaussians and sparse points: one set of options per Blender scene, for splats and Geometry Nodes.

While the extension is loaded in a window, the options decide what the viewport shows; a file on disk shows ellipsoids,
so that it can be viewed without the extension. Renders always show ellipsoids.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import bpy
from bpy.app.handlers import persistent

from ..blender_data import find_owned_objects, get_attribute
from .gaussian_nodes import DIMMING, THRESHOLD, find_modifiers, get_input, renew_nodes, set_input
from .viewport import has_window, redraw_viewports

Style = Literal["SPLATS", "ELLIPSOIDS", "NONE"]


@dataclass(frozen=True, kw_only=True)
class Appearance:
    """style: how viewports show Gaussians; highlight: whether those that match the prompt are lit and others dimmed;
    threshold: least probability of a match; dimming: how much to darken the others."""

    style: Style = "SPLATS"
    highlight: bool = True
    threshold: float = THRESHOLD
    dimming: float = DIMMING


def appearance_of(bpy_scene: bpy.types.Scene) -> Appearance:
    """The options of this Blender scene's panel; the defaults if the extension is not registered."""
    settings = getattr(bpy_scene, "fruitlangs", None)
    if settings is None:
        return Appearance()
    chosen = settings.look
    return Appearance(
        style=chosen.style,
        highlight=chosen.highlight,
        threshold=settings.config.count.threshold,
        dimming=chosen.dimming,
    )


def apply_appearance(bpy_scene: bpy.types.Scene) -> None:
    """Apply the options to this Blender scene's modifiers; those of an older version get the current nodes."""
    look = appearance_of(bpy_scene)
    as_splats = look.style == "SPLATS" and has_window()
    for item in find_owned_objects(bpy_scene, "points"):
        for modifier in find_modifiers(item):
            renew_nodes(modifier)
            _set_inputs(item, modifier, {"In Viewport": not as_splats})
    for item in find_owned_objects(bpy_scene, "gaussians"):
        values = {
            "Highlight": look.highlight and is_answered(item.data),
            "Threshold": look.threshold,
            "Dimming": look.dimming,
            "In Viewport": look.style != "NONE" and not as_splats,
        }
        for modifier in find_modifiers(item):
            renew_nodes(modifier)
            _set_inputs(item, modifier, values)


def set_threshold(bpy_scene: bpy.types.Scene, threshold: float) -> None:
    """Set the threshold of the highlight in a file that is written without the extension's panel."""
    for item in find_owned_objects(bpy_scene, "gaussians"):
        for modifier in find_modifiers(item):
            _set_inputs(item, modifier, {"Threshold": threshold})


def is_answered(mesh: bpy.types.Mesh) -> bool:
    """Whether the Gaussians of this mesh have probabilities of a prompt."""
    return not mesh.is_editmode and "probability" in mesh.attributes and bool(get_attribute(mesh, "probability").any())


def apply_changed_appearance(settings: Any, _context: Any = None) -> None:
    """Called when the options or the threshold were edited."""
    if settings.id_data.library is None:
        apply_appearance(settings.id_data)
        redraw_viewports()


def _set_inputs(item: bpy.types.Object, modifier: Any, values: dict[str, Any]) -> None:
    """Set the inputs that differ; setting an input evaluates the object again."""
    changed = {name: value for name, value in values.items() if get_input(modifier, name) != value}
    for name, value in changed.items():
        set_input(modifier, name, value)
    if changed:
        item.update_tag()


@persistent
def apply_appearances(_file: Any = None, _unused: Any = None) -> None:
    """After loading, saving, undo and redo: apply the options to what viewports show."""
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.library is None and hasattr(bpy_scene, "fruitlangs"):
            apply_appearance(bpy_scene)


@persistent
def show_ellipsoids(_file: Any = None, _unused: Any = None) -> None:
    """Before saving, and when the extension is disabled: without it only ellipsoids can be shown."""
    for bpy_scene in bpy.data.scenes:
        if appearance_of(bpy_scene).style != "SPLATS" or not has_window():
            continue
        for item in [*find_owned_objects(bpy_scene, "gaussians"), *find_owned_objects(bpy_scene, "points")]:
            for modifier in find_modifiers(item):
                _set_inputs(item, modifier, {"In Viewport": True})


HANDLERS = {
    "load_post": apply_appearances,
    "undo_post": apply_appearances,
    "redo_post": apply_appearances,
    "save_pre": show_ellipsoids,
    "save_post": apply_appearances,
    "save_post_fail": apply_appearances,
}


def register_handlers() -> None:
    """Let the options decide what viewports show, except in files on disk."""
    for name, function in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(function)
    if has_window():  # the .blend must not change while an extension is registered
        bpy.app.timers.register(apply_appearances, first_interval=0.0)


def unregister_handlers() -> None:
    """Remove what `register_handlers` added; the viewports show ellipsoids again."""
    if bpy.app.timers.is_registered(apply_appearances):
        bpy.app.timers.unregister(apply_appearances)
    for name, function in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if function in handlers:
            handlers.remove(function)
    if hasattr(bpy.types.Scene, "fruitlangs"):
        show_ellipsoids()
