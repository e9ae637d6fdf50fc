"""Keeps paths in the .blend relative to it, wherever it is saved; Blender does this only for its own.

A folder that is moved together with the .blend is found again, and no home folder is passed on with a file. On another
drive a path stays absolute.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..blender_data import OWNER
from .settings import PHOTO_FILE, PHOTO_PROBLEM, make_relative_path

PATH_SUBTYPES = ("FILE_PATH", "DIR_PATH")
MESSAGES = {"result": "notices", "answer": "problem", "teach": "saved"}
"""{group of `scene.fruitlangs`: its text that may contain a path}."""


@dataclass(frozen=True)
class StoredPath:
    """A path in the .blend: a property of a property group, a custom property, or the file of an image."""

    owner: Any
    name: str
    custom: bool = False

    @property
    def text(self) -> str:
        return str(self.owner[self.name] if self.custom else getattr(self.owner, self.name))

    def write(self, text: str) -> None:
        """Replace it; an equal text is not written, because that would count as a change."""
        if text == self.text:
            return
        if self.custom:
            self.owner[self.name] = text
            return
        if isinstance(self.owner, bpy.types.Image):
            # Blender writes the whole buffer, which still has the end of a longer path.
            setattr(self.owner, self.name, "-" * len(self.text))
        setattr(self.owner, self.name, text)


@persistent
def rebase_paths(file: str, _unused: Any = None) -> None:
    """Before saving as `file`: make paths relative to its folder."""
    if file:
        _hide_temporary()
        _shorten_messages()
        _rebase(_find_opened_folder(), Path(file).parent)


@persistent
def restore_paths(file: str, _unused: Any = None) -> None:
    """After saving, saving a copy or a failed save: make paths relative to the open file."""
    if file:
        _rebase(Path(file).parent, _find_opened_folder())
        _show_temporary()


def _find_opened_folder() -> Path | None:
    """Find the folder of the open file; None if it was never saved."""
    return Path(bpy.data.filepath).parent if bpy.data.filepath else None


def _rebase(old: Path | None, new: Path | None) -> None:
    """Make paths relative to the folder `new` that are absolute or relative to the folder `old`; absolute if `new` is
    None. Without `old`, relative paths stay as they are."""
    for stored in iterate_stored_paths():
        text = stored.text
        if text.startswith("//"):
            if old is None or old == new:
                continue
            text = bpy.path.abspath(text, start=str(old))
        if Path(text).is_absolute():  # otherwise it is empty, or the name of a network on a hub
            stored.write(os.path.normpath(text) if new is None else make_relative_path(Path(text), new))


def iterate_stored_paths() -> Iterator[StoredPath]:
    """Yield all paths of this extension in the open file."""
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.library is None and hasattr(bpy_scene, "fruitlangs"):
            yield from _paths_of(bpy_scene.fruitlangs)
    for item in bpy.data.objects:
        if item.get(OWNER) == "camera" and item.get(PHOTO_FILE) and item.library is None:
            yield StoredPath(item, PHOTO_FILE, custom=True)
    for image in _list_photos():
        yield StoredPath(image, "filepath_raw")  # `filepath` would load it again


def _list_photos() -> list[bpy.types.Image]:
    """List the photos that are shown behind cameras."""
    return [image for image in bpy.data.images if image.get(OWNER) == "photo" and image.library is None]


def _paths_of(group: Any) -> Iterator[StoredPath]:
    """The paths of a property group and of the groups in it."""
    for each in group.bl_rna.properties:
        if _is_path(each):
            yield StoredPath(group, each.identifier)
        elif _has_paths(each):
            value = getattr(group, each.identifier)
            for part in value if each.type == "COLLECTION" else (value,):
                yield from _paths_of(part)


def _is_path(prop: Any) -> bool:
    return prop.type == "STRING" and prop.subtype in PATH_SUBTYPES


def _has_paths(prop: Any) -> bool:
    """Whether a property is a property group, or a collection of them, that contains paths."""
    return prop.type in ("POINTER", "COLLECTION") and _contains_paths(prop.fixed_type)


@cache  # saving asks for every fruit of every decision
def _contains_paths(struct: Any) -> bool:
    own = struct.base is not None and struct.base.identifier == "PropertyGroup"
    return own and any(_is_path(each) or _has_paths(each) for each in struct.properties)


# Undistorted photos are in Blender's temporary folder, which is gone in the next session: {image: its file}, while the
# .blend is written without them.
_temporary: dict[bpy.types.Image, str] = {}


def find_temporary_folder() -> Path:
    """Return Blender's folder of temporary files."""
    return Path(bpy.app.tempdir)


def _hide_temporary() -> None:
    for image in _list_photos():
        if Path(bpy.path.abspath(image.filepath_raw)).is_relative_to(find_temporary_folder()):
            _temporary[image] = bpy.path.abspath(image.filepath_raw)
            StoredPath(image, "filepath_raw").write("")


def _show_temporary() -> None:
    for image, file in _temporary.items():
        image.filepath_raw = file
    _temporary.clear()


def _shorten_messages() -> None:
    """Write the home folder as ~ in messages, which a file that is passed on contains too."""
    for message in _iterate_messages():
        message.write(message.text.replace(str(Path.home()), "~"))


def _iterate_messages() -> Iterator[StoredPath]:
    for bpy_scene in bpy.data.scenes:
        if bpy_scene.library is None and hasattr(bpy_scene, "fruitlangs"):
            settings = bpy_scene.fruitlangs
            for group, name in MESSAGES.items():
                yield StoredPath(getattr(settings, group), name)
            yield StoredPath(settings, "error")
            yield from (StoredPath(finding, "text") for finding in settings.check.findings)
    for item in bpy.data.objects:
        if item.get(PHOTO_PROBLEM) and item.library is None:
            yield StoredPath(item, PHOTO_PROBLEM, custom=True)


HANDLERS = {"save_pre": rebase_paths, "save_post": restore_paths, "save_post_fail": restore_paths}


def register_handlers() -> None:
    """Follow where the file is saved."""
    for name, function in HANDLERS.items():
        getattr(bpy.app.handlers, name).append(function)


def unregister_handlers() -> None:
    """Take back what `register_handlers` added."""
    _contains_paths.cache_clear()
    for name, function in HANDLERS.items():
        handlers = getattr(bpy.app.handlers, name)
        if function in handlers:
            handlers.remove(function)
