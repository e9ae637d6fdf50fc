"""The extension's preferences: for now, whether all it needs is there."""

from __future__ import annotations

import bpy

from ..operators.dependencies import FRUITLANGS_OT_copy_install_command, install_command, missing_packages

PACKAGE = __package__.rpartition(".")[0]
"""Blender's name for the extension (`bl_ext.….fruitlangs`)."""


class FRUITLANGS_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = PACKAGE

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        missing = missing_packages()
        if not missing:
            layout.label(text="All Python packages are installed.", icon="CHECKMARK")
            return
        layout.label(text=f"Missing Python packages: {', '.join(missing)}", icon="ERROR")
        layout.label(text="This zip holds none of them. Run in a terminal, then restart Blender:")
        layout.label(text=install_command(missing))
        layout.operator(FRUITLANGS_OT_copy_install_command.bl_idname, icon="COPYDOWN")


CLASSES = (FRUITLANGS_AP_preferences,)
