"""Paths relative to the .blend stay true when it is saved into another folder; Blender does this for its own alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from .settings import path_names, relative_path, stage_classes

CHOSEN, REACHED = ("source", "out", "gaussians"), ("folder", "features", "exported", "source", "work")
"""The paths of `scene.fruitlangs` and of its result; those among the stages' settings say so themselves."""


@persistent
def rebase_paths(file: str, _unused: Any = None) -> None:
    """Before saving as `file`: say relative to its folder where things are."""
    if file and bpy.data.filepath:
        _rebase(Path(bpy.data.filepath).parent, Path(file).parent)


@persistent
def restore_paths(file: str, _unused: Any = None) -> None:
    """After saving a copy, or in vain: the open file stays where it is."""
    if file and bpy.data.filepath:
        _rebase(Path(file).parent, Path(bpy.data.filepath).parent)


def _rebase(old: Path, new: Path) -> None:
    """Say relative to the folder `new` what the panel's paths say relative to `old`."""
    if old == new:
        return
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.library is None:
            settings = bpy_scene.fruitlangs
            stages = [(getattr(settings.config, stage), path_names(kind)) for stage, kind in stage_classes().items()]
            for group, names in ((settings, CHOSEN), (settings.result, REACHED), *stages):
                _rebase_texts(group, names, old, new)


def _rebase_texts(group: Any, names: Sequence[str], old: Path, new: Path) -> None:
    for name in names:
        text = getattr(group, name)
        if text.startswith("//"):
            setattr(group, name, relative_path(Path(bpy.path.abspath(text, start=str(old))), new))


HANDLERS = {"save_pre": rebase_paths, "save_post": restore_paths, "save_post_fail": restore_paths}


def register_handlers() -> None:
    """Notice where the file is saved."""
    for name, function in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(function)


def unregister_handlers() -> None:
    """Take back what `register_handlers` added."""
    for name, function in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if function in handlers:
            handlers.remove(function)
