"""Opens photos with or without cameras, a video, another program's Gaussians, or an earlier result."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.progress import part
from ..jobs.jobs import JobOperator, Work, is_being_edited, is_busy, is_linked
from ..settings.settings import PLY, SCENE_FILES, format_stored_path, read_config, result_folder, source_folder
from .show_result import report_line, show_reconstruction, show_result, show_scene

if TYPE_CHECKING:
    from ...engine.config import Config
    from ...engine.progress import Progress
    from ...engine.publishing import Result
    from ...engine.scene.camera import Scene


class FRUITLANGS_OT_import_scene(JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.import_scene"
    bl_label = "Import Scene"
    bl_description = (
        "Import the cameras and sparse points of photos or a video, the Gaussians of a .ply, or an earlier result"
    )
    bl_options = {"UNDO"}

    title = "Import"
    replaces_objects = True
    _show: Callable[..., None]

    # The dialog gives both: the open folder, and the file chosen in it, if any.
    directory: bpy.props.StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", "HIDDEN"})
    filepath: bpy.props.StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE", "HIDDEN"})
    filter_glob: bpy.props.StringProperty(
        default=";".join(f"*{suffix}" for suffix in SCENE_FILES), options={"SKIP_SAVE", "HIDDEN"}
    )
    ask: bpy.props.BoolProperty(
        options={"SKIP_SAVE", "HIDDEN"}, description="Choose a scene even if one is set already"
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return (
            not (is_busy(cls) or is_linked(cls, context) or is_being_edited(cls, context)) and context.scene is not None
        )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if not bpy.app.background and self.must_ask(context.scene.fruitlangs):
            return self.ask_where(context)
        return super().invoke(context, event)

    def must_ask(self, settings: Any) -> bool:
        """Whether the user still has to choose what to import."""
        return not self.chosen and (self.ask or not settings.source)

    @property
    def chosen(self) -> str:
        """A .ply or a video, or a folder, also if another file in it was chosen; empty without a choice."""
        return self.filepath if self.filepath.lower().endswith(SCENE_FILES) else self.directory or self.filepath

    def prepare(self, context: bpy.types.Context) -> Work:
        settings = context.scene.fruitlangs
        if self.chosen:
            settings.source = format_stored_path(Path(bpy.path.abspath(self.chosen)))
        source = source_folder(settings)
        if (source / "fruits.json").is_file():
            self._show = self._show_result
            return lambda progress: open_folder(source)
        config, out = read_config(settings, source), result_folder(settings)
        if source.suffix.lower() == PLY:
            self._show = self._show_reconstruction
            return lambda progress: read_cloud(source, out, config, progress)
        self._show = self._show_scene
        return lambda progress: read_posed(source, out, config, progress)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        self._show(context, self._target.scene(context), result)

    def _show_scene(self, context: bpy.types.Context, bpy_scene: bpy.types.Scene, posed: PosedScene) -> None:
        notices = show_scene(context, bpy_scene, posed.scene, posed.notices)
        shown = f"{len(posed.scene.cameras)} cameras and {len(posed.scene.points)} points imported"
        self.report({"INFO"}, "; ".join([shown, *notices]))

    def _show_reconstruction(self, context: bpy.types.Context, bpy_scene: bpy.types.Scene, result: Any) -> None:
        notices = show_reconstruction(context, bpy_scene, *result)
        self.report({"INFO"}, "; ".join([f"{len(result[0].gaussians):,} Gaussians imported", *notices]))

    def _show_result(self, context: bpy.types.Context, bpy_scene: bpy.types.Scene, result: Any) -> None:
        settings = bpy_scene.fruitlangs
        settings.prompt = ", ".join(result.origin["prompts"])
        settings.negative = ", ".join(result.origin.get("negatives", ()))
        settings.config.count.threshold = result.config.count.threshold
        show_result(context, bpy_scene, result)
        self.report({"INFO"}, f"{report_line(settings.result)}; opened as it was counted")


def open_folder(folder: Path) -> Result:
    """The earlier result in `folder`."""
    from ...engine.open_result import open_result

    return open_result(folder)


def read_cloud(file: Path, out: Path, config: Config, progress: Progress) -> Any:
    """The Gaussians or coloured points of `file` with cameras placed around them, and the log of the run."""
    from ...engine.pipeline import reconstruct_scene

    return reconstruct_scene(file, out, config=config, progress=progress)


@dataclass(frozen=True)
class PosedScene:
    """Photos with their cameras, and messages for the user."""

    scene: Scene
    notices: Sequence[str]


def read_posed(path: Path, out: Path, config: Config, progress: Progress) -> PosedScene:
    """The photos at `path`, or stills of the video, with their cameras.

    For photos alone and a video, cameras are estimated first and cached in the result folder `out` for a later count.
    """
    from ...engine.result_folder import ResultFolder
    from ...engine.scene.source import Source

    source, folder = Source(path=path), ResultFolder(out)
    if source.is_alone():
        with folder.lock():
            source = source.find_poses(folder.cache, config.photos, progress=part(progress, 0.0, 0.9))
        progress = part(progress, 0.9, 1.0)
    return PosedScene(source.read(config.scene, progress), [*source.notices, *source.open().notices])


def menu_entry(self: Any, context: bpy.types.Context) -> None:
    """File > Import."""
    self.layout.operator(FRUITLANGS_OT_import_scene.bl_idname, text="Fruit Scene or Result (FruitLangs)").ask = True


CLASSES = (FRUITLANGS_OT_import_scene,)
