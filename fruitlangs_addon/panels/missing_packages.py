"""The message and the install button that a panel shows if Python packages are missing."""

from __future__ import annotations

from typing import Any

import bpy

from ...operators.packages.dependencies import (
    FRUITLANGS_OT_confirm_install,
    FRUITLANGS_OT_copy_install_command,
    FRUITLANGS_OT_install_dependencies,
    find_missing_packages,
)
from .panel_parts import draw_job, draw_text


def draw_missing_packages(layout: Any, context: bpy.types.Context) -> bool:
    """Draw the missing packages with the ways to get them, or the progress of their installation; False if none is
    missing."""
    missing = find_missing_packages()
    if not missing:
        return False
    box = layout.box()
    box.label(text="Python packages are missing", icon="ERROR")
    draw_text(box, ", ".join(missing), context)
    if not draw_job(box, FRUITLANGS_OT_install_dependencies.title, context):
        box.operator(FRUITLANGS_OT_confirm_install.bl_idname, text="Install…", icon="IMPORT")
        box.operator(FRUITLANGS_OT_copy_install_command.bl_idname, icon="COPYDOWN")
    return True
