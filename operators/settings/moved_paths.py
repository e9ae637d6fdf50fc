"""Keeps paths relative to the .blend valid when it is saved to another folder; Blender does this only for its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from .settings import path_names, relative_path, stage_classes

CHOSEN, REACHED = ("source", "out", "gaussians"), ("folder", "features", "exported", "source", "work")
CHECKED, ORCHARD = ("source",), ("folder",)
"""The path properties of `scene.fruitlangs` and of its result, photo check and block; those among the stages' settings
are found separately."""


@persistent
def rebase_paths(file: str, _unused: Any = None) -> None:
    """Before saving as `file`: make paths relative to its folder."""
    if file and bpy.data.filepath:
        _rebase(Path(bpy.data.filepath).parent, Path(file).parent)


@persistent
def restore_paths(file: str, _unused: Any = None) -> None:
    """After saving a copy or a failed save: restore the paths, because the open file did not move."""
    if file and bpy.data.filepath:
        _rebase(Path(file).parent, Path(bpy.data.filepath).parent)


def _rebase(old: Path, new: Path) -> None:
    """Make the panel's paths relative to the folder `new` instead of `old`."""
    if old == new:
        return
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.library is None:
            settings = bpy_scene.fruitlangs
            stages = [(getattr(settings.config, stage), path_names(kind)) for stage, kind in stage_classes().items()]
            own = [
                (settings, CHOSEN),
                (settings.result, REACHED),
                (settings.check, CHECKED),
                (settings.block, ORCHARD),
            ]
            for group, names in (*own, *stages):
                _rebase_texts(group, names, old, new)


def _rebase_texts(group: Any, names: Sequence[str], old: Path, new: Path) -> None:
    for name in names:
        text = getattr(group, name)
        if text.startswith("//"):
            setattr(group, name, relative_path(Path(bpy.path.abspath(text, start=str(old))), new))


HANDLERS = {"save_pre": rebase_paths, "save_post": restore_paths, "save_post_fail": restore_paths}


def register_handlers() -> None:
    """Follow where the file is saved."""
    for name, function in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(function)


def unregister_handlers() -> None:
    """Take back what `register_handlers` added."""
    for name, function in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if function in handlers:
            handlers.remove(function)
