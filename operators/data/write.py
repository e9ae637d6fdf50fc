"""Writes engine values to Blender: everything about one result, into the open file or as a .blend of its own."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from numpy.typing import NDArray

from ...engine.errors import OutputError
from ...engine.storage.files import replace_file
from ..blender_data import OWNER, ensure_owned_collection, find_owned_objects, make_object
from ..settings.panel_state import PanelState, store_panel
from ..settings.settings import PHOTO_FILE, make_relative_path
from ..viewport.appearance import set_threshold
from ..viewport.gaussian_nodes import THRESHOLD
from ..viewport.viewport import look_at_scene, show_colors
from .stored_audit import write_audit
from .write_cameras import write_cameras
from .write_fruits import write_fruits
from .write_gaussians import write_gaussians
from .write_root import write_root

if TYPE_CHECKING:
    from torch import Tensor

    from ...engine.counting.fruit import FruitCount
    from ...engine.scene.camera import Scene
    from ...engine.splatting.gaussians import Gaussians

SET_ID = "fruitlangs_set_id"
"""Custom property of the Blender scene: the set of result files that it shows."""


def write_result(
    bpy_scene: bpy.types.Scene,
    scene: Scene,
    gaussians: Gaussians,
    probability: Tensor | NDArray[Any] | None,
    fruit_count: FruitCount,
    asked: str = "",
) -> bpy.types.Object:
    """Put a counted scene into a Blender scene and return its root empty.

    Everything from an earlier call is replaced; other data are not changed. Coordinates below the root are those of the
    input scene (see `write_root`). probability: (N,) of the prompt for each Gaussian; asked: the prompt, of
    `join_asked_words`.
    """
    root = write_root(bpy_scene, scene)
    write_gaussians(bpy_scene, scene, gaussians, probability, fruit_count.fruits, root, asked)
    write_fruits(bpy_scene, fruit_count, root, metres_per_unit=scene.metres_per_unit)
    write_cameras(bpy_scene, scene, root)
    write_audit(bpy_scene, fruit_count.audit)
    return root


def write_blend(
    path: Path,
    scene: Scene,
    gaussians: Gaussians,
    probability: Tensor | NDArray[Any] | None,
    fruit_count: FruitCount,
    *,
    asked: str = "",
    set_id: str = "",
    threshold: float = THRESHOLD,
    folder: Path | None = None,
    panel: PanelState | None = None,
) -> None:
    """Write a result as a .blend of its own, with light and a camera, ready to be opened or rendered.

    For the command line: it starts from an empty file, so it refuses to run in a window. The file is written completely
    or not at all, and no .blend1 is left. set_id names the set of result files it belongs to (see `fruits.json`); it
    becomes the scene's custom property `fruitlangs_set_id`. asked: the prompt, from `join_asked_words`; threshold:
    probability above which Gaussians are highlighted; folder: where the file is moved to later, None for where it is
    written; the photos are found from there; panel: what the extension's panel shows when it opens the file.

    Raises:
        OutputError: the file cannot be written, or a window is open.
    """
    if not bpy.app.background:
        raise OutputError(
            f"{path.name}: a .blend of its own is written in background mode only. Use File > Save instead"
        )
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy_scene = bpy.context.scene
    root = write_result(bpy_scene, scene, gaussians, probability, fruit_count, asked)
    set_threshold(bpy_scene, threshold)
    light_scene(bpy_scene, root)
    show_colors(bpy.data.screens, splats=False)
    look_at_scene(bpy.data.screens, bpy_scene)
    if set_id:
        bpy_scene[SET_ID] = set_id
    for item in find_owned_objects(bpy_scene, "camera"):
        if PHOTO_FILE in item:
            item[PHOTO_FILE] = make_relative_path(Path(item[PHOTO_FILE]), (folder or path.parent).absolute())
    if panel is not None:
        store_panel(bpy_scene, panel)
    save_blend(path)


def light_scene(bpy_scene: bpy.types.Scene, root: bpy.types.Object) -> None:
    """Add a sun, a grey sky and plain colour management, so that a render shows the attributes."""
    sun = bpy.data.lights.new("Sun", "SUN")
    sun.energy, sun.angle = 2.5, 0.1
    item = make_object("Sun", sun, "light", ensure_owned_collection(bpy_scene, "scene", "FruitLangs"), None)
    item.rotation_euler = (0.6, 0.3, 0.0)
    item.location = (0.0, 0.0, 40.0 * root.empty_display_size)
    world = bpy.data.worlds.new("Sky")
    world[OWNER] = "world"
    world.use_nodes = True
    sky = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    sky.inputs["Color"].default_value = (0.32, 0.34, 0.37, 1.0)
    bpy_scene.world = world
    bpy_scene.view_settings.view_transform = "Standard"


def save_blend(path: Path) -> None:
    """Save a copy of the open file as `path`, atomically.

    Raises:
        OutputError: the folder or file cannot be written.
    """
    with replace_file(path) as part:
        try:
            with _silence():
                bpy.ops.wm.save_as_mainfile(filepath=str(part), copy=True, check_existing=False, compress=True)
        except RuntimeError as error:  # Blender's error for a file that cannot be saved
            raise OutputError(f"{path} cannot be written ({str(error).strip()}). Choose another folder") from error


@contextmanager
def _silence() -> Iterator[None]:
    """Suppress Blender's message "Saved copy as" with the temporary name, which would mislead.

    Blender prints through C's buffer, which is flushed before and after; otherwise the message would appear later.
    """
    libc = ctypes.CDLL("ucrtbase" if os.name == "nt" else None)
    sys.stdout.flush()
    libc.fflush(None)
    kept = os.dup(1)
    try:
        with open(os.devnull, "w", encoding="utf-8") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        yield
    finally:
        libc.fflush(None)
        os.dup2(kept, 1)
        os.close(kept)
