"""Caches that can be cleared: compiled kernels, downloaded checkpoints, the cached stages of the shown scene."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import bpy

from ...engine.errors import FruitLangsError
from ...engine.user_folders import KERNELS, checkpoints_folder, kernels_folder
from ..jobs.jobs import is_busy
from ..settings.settings import result_folder

STAGES = ("photos-", "train-", "embed-", "imported-", "segments-", "publish", "spool")
"""Prefixes of the folders of a run in the cache of its results."""
LOST = "Training starts again; a scene without a count needs it before the next prompt"
"""The consequence of deleting the cached stages of a scene."""


def list_kernel_caches() -> list[Path]:
    """List the folders of compiled kernels, of this version and of earlier ones."""
    return sorted(path for path in _list_entries(kernels_folder()) if path.is_dir() and path.name.startswith(KERNELS))


def list_downloaded_checkpoints() -> list[Path]:
    """List the folders of CLIP and SAM checkpoints, downloaded or copied there."""
    return sorted(path for path in _list_entries(checkpoints_folder()) if path.is_dir())


def find_work_folder(bpy_scene: bpy.types.Scene) -> Path | None:
    """Find the cache folder of runs on the chosen scene; None if unknown."""
    settings = bpy_scene.fruitlangs
    if not settings.source and not settings.out:
        return None
    try:
        return result_folder(settings) / "cache"
    except FruitLangsError:  # relative to a .blend never saved
        return None


def list_work_caches(bpy_scene: bpy.types.Scene) -> list[Path]:
    """List the folders of finished stages and checkpoints of the chosen scene, without other files next to them."""
    folder = find_work_folder(bpy_scene)
    entries = [] if folder is None else _list_entries(folder)
    return sorted(path for path in entries if path.is_dir() and path.name.startswith(STAGES))


def _list_entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def measure_megabytes(folders: Iterable[Path]) -> float:
    """Measure the size of the files in these folders."""
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file() and not file.is_symlink()]
    return sum(file.stat().st_size for file in files) / 1e6


class FRUITLANGS_OT_clear_caches(bpy.types.Operator):
    bl_idname = "fruitlangs.clear_caches"
    bl_label = "Clear Caches"
    bl_description = (
        "Show the size of compiled kernels, downloaded checkpoints and the cache of this scene, and delete what you "
        "choose"
    )

    kernels: bpy.props.BoolProperty(
        name="Compiled Kernels",
        default=True,
        description="Machine code of this computer; compiling it again takes about a minute",
    )
    checkpoints: bpy.props.BoolProperty(
        name="CLIP and SAM",
        default=False,
        description="Checkpoints that were downloaded or put into the same folder",
    )

    work: bpy.props.BoolProperty(
        name="Scene Cache",
        default=False,
        description="Checkpoints and finished stages of this scene; results stay, training starts again",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not is_busy(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        found = list_kernel_caches(), list_downloaded_checkpoints(), list_work_caches(context.scene)
        self._sizes = [measure_megabytes(folders) for folders in found]
        return context.window_manager.invoke_props_dialog(self, width=520, confirm_text="Delete")

    def draw(self, context: bpy.types.Context) -> None:
        places = {
            "kernels": kernels_folder(),
            "checkpoints": checkpoints_folder(),
            "work": find_work_folder(context.scene),
        }
        for (name, place), size in zip(places.items(), self._sizes, strict=True):
            if place is None:
                continue
            row = self.layout.row()
            row.prop(self, name)
            row.label(text=f"{size:,.1f} MB in {place}")
        if self.work:
            self.layout.label(text=LOST, icon="INFO")

    def execute(self, context: bpy.types.Context) -> set[str]:
        if is_busy(type(self)):  # started since the dialog was opened
            self.report({"ERROR"}, "A job is running. Wait for it or cancel it first")
            return {"CANCELLED"}
        chosen = (list_kernel_caches() if self.kernels else []) + (
            list_downloaded_checkpoints() if self.checkpoints else []
        )
        chosen += list_work_caches(context.scene) if self.work else []
        size = measure_megabytes(chosen)
        for folder in chosen:
            shutil.rmtree(folder, ignore_errors=True)
        left = [folder for folder in chosen if folder.exists()]
        if left:
            self.report({"WARNING"}, f"{left[0]} is in use or protected. Close Blender and delete it manually")
        self.report({"INFO"}, f"{size - measure_megabytes(left):,.1f} MB deleted")
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_clear_caches,)
