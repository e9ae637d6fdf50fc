"""Draws the current state of training in the viewport without changing the .blend."""

from __future__ import annotations

import time
from collections.abc import Callable, Set
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from mathutils import Matrix, Vector

from ...engine.errors import SceneError
from ..blender_data import find_owned_object, to_array
from ..data.write_gaussians import REACH
from ..data.write_root import GROUND, find_focus, root_matrix
from ..drawing import splat_drawing
from ..jobs.jobs import JobOperator, is_being_edited, is_busy, is_linked
from ..jobs.target_scene import find_scene
from ..scene_frame import scene_frame
from ..settings.settings import (
    is_of_another,
    list_given_settings,
    read_config,
    resolve_imported_file,
    result_folder,
    source_folder,
)
from ..viewport.splats import Splats, splats_in_training
from ..viewport.viewport import find_screens, look_from_around

if TYPE_CHECKING:
    from ...engine.config import Config
    from ...engine.scene.camera import Scene
    from ...engine.splatting.gaussians import Gaussians

SHOW_SECONDS = 4.0
"""Seconds between two pictures: drawing slows down training."""


class Preview:
    """Takes Gaussians in a thread and shows them on the main thread, in one Blender scene, upright as they will be when
    `source` is trained.

    The scene may show another source, or nothing: then the trained scene defines the root, and the viewports are turned
    to it.
    """

    def __init__(self, bpy_scene: bpy.types.Scene, source: Path) -> None:
        root = find_owned_object(bpy_scene, "root")
        other = is_of_another(bpy_scene.fruitlangs, source)
        self._scene = bpy_scene.session_uid
        self._root: Any = None if root is None or other else _find_world_transform(bpy_scene)
        self._ground = None if other or GROUND not in bpy_scene else list(bpy_scene[GROUND])
        self._latest: tuple[Splats, Scene] | None = None
        self._shown: Splats | None = None
        self._last = time.monotonic()

    def watch(self, gaussians: Gaussians, scene: Scene) -> None:
        """Keep a copy of the Gaussians; called by the training thread."""
        splats = splats_in_training(
            to_array(gaussians.means),
            to_array(gaussians.scales),
            to_array(gaussians.quats),
            to_array(gaussians.base_colors),
            to_array(gaussians.opacities),
            gaussians.antialiased,
        )
        self._latest = splats, scene

    def show(self, context: bpy.types.Context) -> None:
        """Draw the latest state, if it is new and the last picture is old enough; on the main thread."""
        if self._latest is None or self._latest[0] is self._shown or time.monotonic() - self._last < SHOW_SECONDS:
            return
        splats, scene = self._latest
        matrix = root_matrix(scene, self._ground) if self._root is None else self._root
        if self._shown is None and self._root is None:
            self._turn_to(context, scene, matrix)
        self._shown, self._last = splats, time.monotonic()
        centre = tuple(find_focus(scene).tolist())
        splat_drawing.show_preview(self._scene, splat_drawing.Interim(splats, matrix, centre, REACH * scene.extent))

    def _turn_to(self, context: bpy.types.Context, scene: Scene, matrix: Matrix) -> None:
        bpy_scene = find_scene(self._scene)
        if bpy_scene is not None:
            places = [matrix @ Vector(camera.center.tolist()) for camera in scene.cameras]
            look_from_around(find_screens(context, bpy_scene), places, Matrix())

    def remove(self) -> None:
        """Draw the Gaussians of the .blend again."""
        splat_drawing.show_preview(self._scene, None)


def _find_world_transform(bpy_scene: bpy.types.Scene) -> Matrix | None:
    """Return the transform from the shown scene's frame to the world; None if its objects were moved apart."""
    try:
        return scene_frame(bpy_scene).to_world
    except SceneError:
        return None


@dataclass(frozen=True, kw_only=True)
class Run:
    """What the panel says for a run on the chosen scene; the fields are arguments of `count_scene`."""

    source: Path
    out: Path
    imported: Path | None
    config: Config
    given: Set[str]
    watch: Callable[[Gaussians, Scene], None]


class SceneJob(JobOperator):
    """Mix-in of operators that work on the chosen scene and show the state of training; `prepare` calls `read_run`."""

    replaces_objects = True
    _preview: Preview
    _out: Path

    def read_run(self, context: bpy.types.Context) -> Run:
        """Read the settings of the panel, and prepare to show the training.

        Raises:
            FruitLangsError: a file does not exist, or a setting makes no sense.
        """
        settings = context.scene.fruitlangs
        source, self._out = source_folder(settings), result_folder(settings)
        self._preview = Preview(context.scene, source)
        return Run(
            source=source,
            out=self._out,
            imported=resolve_imported_file(settings),
            config=read_config(settings, source),
            given=list_given_settings(settings),
            watch=self._preview.watch,
        )

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context) or is_being_edited(cls, context):
            return False
        if context.scene is None or not context.scene.fruitlangs.source:
            cls.poll_message_set("Choose a scene first")
            return False
        return True

    def update_display(self, context: bpy.types.Context) -> None:
        self._preview.show(context)

    def clear_display(self, context: bpy.types.Context) -> None:
        self._preview.remove()
