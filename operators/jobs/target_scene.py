"""The Blender scene that a job works for, found again when it ends."""

from __future__ import annotations

import bpy

from ...engine.errors import OutputError


class Target:
    """Remembers a Blender scene across undo, renaming and deletion, which a Python reference does not survive."""

    def __init__(self, scene: bpy.types.Scene) -> None:
        self._uid = scene.session_uid
        self._name = scene.name

    def scene(self, context: bpy.types.Context) -> bpy.types.Scene:
        """The scene, after leaving any edit mode in it.

        Raises:
            OutputError: it was deleted, or another file was opened.
        """
        scene = self.find()
        if scene is None:
            raise OutputError(f"The scene {self._name} was deleted or closed. The results are in the results folder")
        _leave_editing(context, scene)
        return scene

    def find(self) -> bpy.types.Scene | None:
        """The scene in its current mode; None if it was deleted or another file was opened."""
        return find_scene(self._uid)


def _leave_editing(context: bpy.types.Context, scene: bpy.types.Scene) -> None:
    """Enter Object Mode in the windows that show the scene; edit modes of other scenes stay."""
    for window in context.window_manager.windows:
        if window.scene == scene:
            with context.temp_override(window=window, scene=scene, view_layer=window.view_layer):
                if bpy.context.mode != "OBJECT" and bpy.ops.object.mode_set.poll():
                    bpy.ops.object.mode_set(mode="OBJECT")


def find_scene(session_uid: int) -> bpy.types.Scene | None:
    """The Blender scene with that session id; None if it no longer exists."""
    return next((scene for scene in bpy.data.scenes if scene.session_uid == session_uid), None)
