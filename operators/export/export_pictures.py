"""Exports pictures for people: a still of the tree with numbered fruit, and the report."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.errors import SceneError
from ...engine.progress import Progress, part
from ...engine.storage.files import replace_file
from ..blender_data import find_owned_object
from ..data.fruit_objects import metres_per_unit
from ..data.read_cameras import read_active_camera, read_scene
from ..data.read_gaussians import StoredGaussians, read_gaussians
from ..data.stored_review import counts_line, entry_text, is_reviewed
from ..data.write import SET_ID
from .export_file import ExportFile, Write

if TYPE_CHECKING:
    from PIL.Image import Image

    from ...engine.counting.fruit import FruitCount
    from ...engine.scene.camera import Camera, Scene

WIDTH = 1600
"""Width of the report's still in pixels."""


class FRUITLANGS_OT_export_still(ExportFile, bpy.types.Operator):
    bl_idname = "fruitlangs.export_still"
    bl_label = "Export Still"
    bl_description = "Write a picture of the tree with every fruit outlined and numbered (.jpg or .png)"

    suffixes = (".jpg", ".jpeg", ".png")

    view: bpy.props.EnumProperty(
        name="View",
        items=[
            ("FRAMED", "Framed", "From the side of a photo that shows most fruit, with the whole tree in it"),
            ("CAMERA", "Active Camera", "From the scene's active camera, at the size that it renders"),
        ],
        description="Viewpoint of the picture",
    )
    width: bpy.props.IntProperty(
        name="Width", default=WIDTH, min=64, soft_max=4000, max=16000, description="Width of the picture in pixels"
    )

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if find_owned_object(context.scene, "gaussians") is None:
            cls.poll_message_set("There are no Gaussians to draw. Count again or import the result")
            return False
        return True

    def prepare_write(self: Any, context: bpy.types.Context, fruit_count: FruitCount) -> Write:
        scene, stored = read_scene(context.scene), read_gaussians(context.scene)
        if stored is None:
            raise SceneError("There are no Gaussians to draw. Count again or import the result")
        camera = read_active_camera(context.scene) if self.view == "CAMERA" else None
        width, text = int(self.width), read_counted_prompt(context.scene)

        def write(path: Path, progress: Progress) -> None:
            save(path, draw(scene, stored, fruit_count, text, camera, width, progress))

        return write


class FRUITLANGS_OT_export_report(ExportFile, bpy.types.Operator):
    bl_idname = "fruitlangs.export_report"
    bl_label = "Export Report"
    bl_description = (
        "Write one page (.html) to read and print: the reviewed count, a numbered picture, sizes, every fruit "
        "and every decision of the review"
    )

    suffixes = (".html",)

    def prepare_write(self, context: bpy.types.Context, fruit_count: FruitCount) -> Write:
        bpy_scene = context.scene
        scene, stored = read_scene(bpy_scene), read_gaussians(bpy_scene)
        text, scale, made = read_counted_prompt(bpy_scene), metres_per_unit(bpy_scene), read_provenance(bpy_scene)
        line = counts_line(bpy_scene) if is_reviewed(bpy_scene) else ""
        decisions = [entry_text(entry) for entry in bpy_scene.fruitlangs.review.log]

        def write(path: Path, progress: Progress) -> None:
            from ...engine.report.page import Reviewed, write_page

            drawing = part(progress, 0.0, 0.95)
            write_page(
                path,
                fruit_count,
                title=text,
                metres_per_unit=scale,
                still=None if stored is None else draw(scene, stored, fruit_count, text, None, WIDTH, drawing),
                reviewed=Reviewed(line=line, interval=fruit_count.interval, decisions=decisions) if line else None,
                provenance=made,
            )

        return write


def draw(
    scene: Scene,
    stored: StoredGaussians,
    fruit_count: FruitCount,
    text: str,
    camera: Camera | None,
    width: int,
    progress: Progress,
) -> Image:
    """The still from a camera, or from an automatic viewpoint with this width if there is none."""
    progress(0.0, "reading the Gaussians")
    from ...engine.report.overview import draw_count
    from ...engine.report.still import draw_still
    from ...engine.report.words import headline

    gaussians, title, drawing = stored.gaussians(), headline(fruit_count, text), part(progress, 0.1, 1.0)
    if camera is None:
        return draw_count(scene, gaussians, fruit_count, title=title, width=width, progress=drawing)
    return draw_still(
        gaussians, fruit_count.fruits, camera, metres_per_unit=scene.metres_per_unit, title=title, progress=drawing
    )


def save(path: Path, still: Image) -> None:
    """Write it as PNG or JPEG, depending on its suffix."""
    from ...engine.report.still import save_still

    if path.suffix.lower() != ".png":
        save_still(path, still)
        return
    with replace_file(path) as temporary:
        still.save(temporary, "PNG", optimize=True)


def read_counted_prompt(bpy_scene: bpy.types.Scene) -> str:
    """Read the counted prompt: 'apple'."""
    shown = bpy_scene.fruitlangs.result
    return str(shown.label or bpy_scene.fruitlangs.prompt)


def read_provenance(bpy_scene: bpy.types.Scene) -> dict[str, Any]:
    """Say how the count was made, as far as a .blend knows; the result folder has all of it.

    Only names of folders are included, because a report is passed on.
    """
    settings, shown = bpy_scene.fruitlangs, bpy_scene.fruitlangs.result
    rows = {
        "blend": Path(bpy.data.filepath).name,
        "scene": PurePath(settings.source.rstrip("/\\")).name,
        "result folder": PurePath(shown.folder.rstrip("/\\")).name,
        "result set": bpy_scene.get(SET_ID, ""),
        "prompts": settings.prompt,
        "negatives": settings.negative,
        "cameras": shown.cameras or "",
        "Gaussians": f"{shown.gaussians:,}" if shown.gaussians else "",
        "quality": shown.quality,
    }
    notices = [shown.notices] if shown.notices else []
    if shown.count == 0 and shown.zero_reason:
        notices.append(f"nothing was counted: {shown.zero_reason}")
    return {"notices": notices, **{name: value for name, value in rows.items() if value}}
