"""The extension's preferences: packages, folders of checkpoints, caches, and what it may do online."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import sys
from typing import Any

import bpy

from ..engine.child_process import usable_cores
from ..operators.package_folder import EXTENSION, list_installs, packages_folder
from ..operators.packages.caches import FRUITLANGS_OT_clear_caches
from ..operators.packages.dependencies import (
    FRUITLANGS_OT_confirm_install,
    FRUITLANGS_OT_install_dependencies,
    find_missing_packages,
    offers_cuda,
)
from ..operators.settings.settings import is_online
from ..operators.steps.device import ON_CPU, describe_device
from .panels.missing_packages import draw_missing_packages
from .panels.panel_parts import draw_job


class FRUITLANGS_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = EXTENSION

    clip: bpy.props.StringProperty(
        name="CLIP Checkpoint",
        subtype="DIR_PATH",
        description="Folder of a CLIP or SigLIP checkpoint, for scenes that keep the default setting",
    )
    sam: bpy.props.StringProperty(
        name="SAM Checkpoint",
        subtype="DIR_PATH",
        description="Folder of a SAM checkpoint, for scenes that keep the default setting",
    )

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        if not draw_missing_packages(layout, context):
            layout.label(text="All Python packages are installed", icon="CHECKMARK")
            if list_installs(packages_folder()):
                layout.label(text=f"Installed in {packages_folder()}", icon="BLANK1")
        layout.label(text=device_text(), icon="DESKTOP")
        draw_cuda(layout, context)
        column = layout.column()
        column.prop(self, "clip")
        column.prop(self, "sam")
        draw_online(layout)
        row = layout.row()
        row.alignment = "LEFT"
        row.operator(FRUITLANGS_OT_clear_caches.bl_idname, text="Clear Caches…", icon="TRASH")


def device_text() -> str:
    """The devices of computation. PyTorch is not imported for it: whether it supports a card is known after its first
    use."""
    cores = usable_cores()
    text = f"Computes on the CPU with {cores} core{'s' if cores > 1 else ''}"
    torch: Any = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_available():
        text += f"; CLIP and SAM on {torch.cuda.get_device_name(0)}"
    elif torch is not None and torch.backends.mps.is_available():
        text += "; CLIP and SAM on the Apple card"
    card = describe_device("auto")
    return text if card in ("", ON_CPU) else f"{text}. {card}"


def draw_cuda(layout: Any, context: bpy.types.Context) -> None:
    """The button that installs PyTorch for NVIDIA cards, where there is a card that it would serve."""
    if (
        find_missing_packages()
        or not offers_cuda(describe_device("auto"))
        or draw_job(layout, FRUITLANGS_OT_install_dependencies.title, context)
    ):
        return
    row = layout.row()
    row.alignment = "LEFT"
    row.operator(
        FRUITLANGS_OT_confirm_install.bl_idname, text="Install PyTorch for NVIDIA Cards…", icon="IMPORT"
    ).cuda = True


def draw_online(layout: Any) -> None:
    """Whether Blender allows online access, and where to change it."""
    if is_online():
        layout.label(text="Online: downloads packages and checkpoints when you ask for them", icon="INTERNET")
        return
    layout.label(text="Offline: online access is disabled in Preferences > System", icon="INTERNET_OFFLINE")
    row = layout.row()
    row.alignment = "LEFT"
    row.operator("screen.userpref_show", text="Open System Preferences", icon="PREFERENCES").section = "SYSTEM"


CLASSES = (FRUITLANGS_AP_preferences,)
