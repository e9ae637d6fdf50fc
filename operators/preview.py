"""What training has made so far, drawn in the viewport without touching anything of the .blend."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import bpy

from .blender_data import array, owned_object
from .splat_drawing import Splats, show_preview

if TYPE_CHECKING:
    from ..engine.splatting.gaussians import Gaussians

SHOW_SECONDS = 4.0
"""Between two pictures: drawing takes its time from the training."""


class Preview:
    """Takes Gaussians in a thread, shows them on the main thread, of one Blender scene that has a root to stand them
    upright."""

    def __init__(self, bpy_scene: bpy.types.Scene) -> None:
        root = owned_object(bpy_scene, "root")
        self._scene = bpy_scene.session_uid
        self._matrix: Any = None if root is None else root.matrix_world.copy()
        self._latest: Splats | None = None
        self._shown: Splats | None = None
        self._last = time.monotonic()

    def watch(self, gaussians: Gaussians) -> None:
        """Keep a copy of the Gaussians; called by the training's thread."""
        if self._matrix is None:
            return
        self._latest = Splats(
            means=array(gaussians.means),
            scales=array(gaussians.scales),
            quats=array(gaussians.quats),
            colors=array(gaussians.base_colors),
            opacities=array(gaussians.opacities),
            probability=None,
        )

    def show(self) -> None:
        """Draw what was kept last, if it is new and the last picture is old enough; on the main thread."""
        if self._latest is None or self._latest is self._shown or time.monotonic() - self._last < SHOW_SECONDS:
            return
        self._shown, self._last = self._latest, time.monotonic()
        show_preview(self._scene, self._shown, self._matrix)

    def remove(self) -> None:
        """Draw what the .blend holds again."""
        show_preview(self._scene, None, self._matrix)
