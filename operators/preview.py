"""What training has made so far, drawn in the viewport without touching anything of the .blend."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from . import splat_drawing
from .blender_data import array, in_scene_frame, owned_object, owned_objects
from .jobs import JobOperator, busy, linked
from .splats import Splats, splats_in_training
from .write_gaussians import REACH

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
        self._centre, self._reach = splat_drawing.EVERYWHERE if root is None else _room(bpy_scene, root)
        self._latest: Splats | None = None
        self._shown: Splats | None = None
        self._last = time.monotonic()

    def watch(self, gaussians: Gaussians) -> None:
        """Keep a copy of the Gaussians; called by the training's thread."""
        if self._matrix is None:
            return
        self._latest = splats_in_training(
            array(gaussians.means),
            array(gaussians.scales),
            array(gaussians.quats),
            array(gaussians.base_colors),
            array(gaussians.opacities),
            gaussians.antialiased,
        )

    def show(self) -> None:
        """Draw what was kept last, if it is new and the last picture is old enough; on the main thread."""
        if self._latest is None or self._latest is self._shown or time.monotonic() - self._last < SHOW_SECONDS:
            return
        self._shown, self._last = self._latest, time.monotonic()
        preview = splat_drawing.Interim(self._shown, self._matrix, self._centre, self._reach)
        splat_drawing.show_preview(self._scene, preview)

    def remove(self) -> None:
        """Draw what the .blend holds again."""
        splat_drawing.show_preview(self._scene, None)


class SceneJob(JobOperator):
    """Mix into an operator that works on the chosen scene and shows what it trains meanwhile; `prepare` sets
    `_preview`."""

    _preview: Preview

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if busy(cls) or linked(cls, context):
            return False
        if context.scene is None or not context.scene.fruitlangs.source:
            cls.poll_message_set("Choose a scene first")
            return False
        return True

    def ticked(self, context: bpy.types.Context) -> None:
        self._preview.show()

    def ended(self, context: bpy.types.Context) -> None:
        self._preview.remove()


def _room(bpy_scene: bpy.types.Scene, root: bpy.types.Object) -> tuple[tuple[float, ...], float]:
    """Centre and reach of what is shown, about as `write_gaussians` will have them: the ring of the cameras."""
    cameras = owned_objects(bpy_scene, "camera")
    if len(cameras) < 2:
        return splat_drawing.EVERYWHERE
    places = np.array([in_scene_frame(item, root).translation for item in cameras])
    middle = places.mean(0)
    return tuple(middle.tolist()), 1.1 * REACH * float(np.linalg.norm(places - middle, axis=1).max())
