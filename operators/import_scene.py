"""Read a scene's cameras and sparse points and show them."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ..engine.progress import part
from .jobs import JobOperator, Work, running
from .settings import read_config, result_folder, source_folder, stored_path
from .target import Target
from .viewport import look_at_scene, show_colors, shown_screens
from .write_cameras import write_cameras
from .write_points import write_points
from .write_root import write_root

if TYPE_CHECKING:
    from ..engine.config import Config
    from ..engine.progress import Progress
    from ..engine.scene.camera import Scene


class FRUITLANGS_OT_import_scene(JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.import_scene"
    bl_label = "Import Scene"
    bl_description = (
        "Show the cameras and the sparse points of photos, with a COLMAP model or alone, or of an earlier result"
    )
    bl_options = {"UNDO"}

    title = "Import"

    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if running() is not None:
            cls.poll_message_set("Another job is at work; wait or cancel it first")
            return False
        return context.scene is not None

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not self.directory and not context.scene.fruitlangs.source and not bpy.app.background:
            context.window_manager.fileselect_add(self)
            return {"RUNNING_MODAL"}
        return super().invoke(context, event)

    def prepare(self, context: bpy.types.Context) -> Work:
        settings = context.scene.fruitlangs
        if self.directory:
            settings.source = stored_path(Path(bpy.path.abspath(self.directory)))
        source = source_folder(settings)
        config, cache = read_config(settings), result_folder(settings) / "cache"
        self._target = Target(context.scene)
        return lambda progress: read_any(source, cache, config, progress)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        bpy_scene = self._target.scene(context)
        root = write_root(bpy_scene, result)
        if len(result.points):
            write_points(bpy_scene, result, root)
        write_cameras(bpy_scene, result, root)
        show_colors(shown_screens(context))
        look_at_scene(shown_screens(context), bpy_scene)
        shown = bpy_scene.fruitlangs.result
        shown.cameras, shown.points = len(result.cameras), len(result.points)
        self.report({"INFO"}, f"{len(result.cameras)} cameras and {len(result.points)} points imported")

    def failed(self, context: bpy.types.Context, message: str) -> None:
        context.scene.fruitlangs.error = message


def read_any(source: Path, cache: Path, config: Config, progress: Progress) -> Scene:
    """The scene at `source`: photos with a camera model, or the cameras that an earlier result keeps of them.

    For photos alone cameras are found first; they are kept in `cache`, where a count finds them again.
    """
    if (source / "fruits.json").is_file():
        from ..engine.scene.stored import read_cameras

        return read_cameras(source / "cameras.json")
    from ..engine.scene.source import Source, photos_alone, pose_photos

    photos = photos_alone(source)
    if photos is None:
        return Source(path=source).read(config.scene, progress)
    found = pose_photos(photos, cache, config.photos, progress=part(progress, 0.0, 0.9))
    return found.read(config.scene, part(progress, 0.9, 1.0))


def menu_entry(self: Any, context: bpy.types.Context) -> None:
    """File > Import."""
    self.layout.operator(FRUITLANGS_OT_import_scene.bl_idname, text="Fruit Scene (COLMAP)")


CLASSES = (FRUITLANGS_OT_import_scene,)
