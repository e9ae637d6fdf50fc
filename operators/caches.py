"""What this computer keeps for the extension and can be cleared: compiled kernels, downloaded checkpoints."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import bpy

from ..engine.user_folders import KERNELS, checkpoints_folder, kernels_folder
from .jobs import busy


def kernel_caches() -> list[Path]:
    """The folders of compiled kernels, of this version and of earlier ones."""
    return sorted(path for path in _entries(kernels_folder()) if path.is_dir() and path.name.startswith(KERNELS))


def downloaded_checkpoints() -> list[Path]:
    """The folders of CLIP and SAM checkpoints that were downloaded, or put where downloads go."""
    return sorted(path for path in _entries(checkpoints_folder()) if path.is_dir())


def _entries(folder: Path) -> list[Path]:
    return list(folder.iterdir()) if folder.is_dir() else []


def megabytes(folders: Iterable[Path]) -> float:
    """What the files in these folders take up."""
    files = [file for folder in folders for file in folder.rglob("*") if file.is_file() and not file.is_symlink()]
    return sum(file.stat().st_size for file in files) / 1e6


class FRUITLANGS_OT_clear_caches(bpy.types.Operator):
    bl_idname = "fruitlangs.clear_caches"
    bl_label = "Clear Caches"
    bl_description = "Say how much compiled kernels and downloaded checkpoints take up, and delete what you choose"

    kernels: bpy.props.BoolProperty(
        name="Compiled kernels",
        default=True,
        description="They are compiled again, in about half a minute, when they are next needed",
    )
    checkpoints: bpy.props.BoolProperty(
        name="CLIP and SAM checkpoints",
        default=False,
        description="Those that were downloaded, and those that you put into the same folder",
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return not busy(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        self._sizes = megabytes(kernel_caches()), megabytes(downloaded_checkpoints())
        return context.window_manager.invoke_props_dialog(self, width=520, confirm_text="Delete")

    def draw(self, context: bpy.types.Context) -> None:
        places = (kernels_folder(), checkpoints_folder())
        for name, size, place in zip(("kernels", "checkpoints"), self._sizes, places, strict=True):
            row = self.layout.row()
            row.prop(self, name)
            row.label(text=f"{size:,.1f} MB in {place}")

    def execute(self, context: bpy.types.Context) -> set[str]:
        chosen = (kernel_caches() if self.kernels else []) + (downloaded_checkpoints() if self.checkpoints else [])
        size = megabytes(chosen)
        for folder in chosen:
            shutil.rmtree(folder, ignore_errors=True)
        left = [folder for folder in chosen if folder.exists()]
        if left:
            self.report({"WARNING"}, f"{left[0]} is in use or protected; close Blender and delete it by hand")
        self.report({"INFO"}, f"{size - megabytes(left):,.1f} MB deleted")
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_clear_caches,)
