"""Checks the photos before a long run, and shows the contact sheet of the check."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.progress import duration
from ..jobs.jobs import ROUNDING, JobOperator, Work, is_busy, is_linked
from ..settings.settings import find_true_source, format_stored_path, read_config, source_folder

if TYPE_CHECKING:
    from ...engine.config import Config
    from ...engine.photo_check.finding import PhotoCheck
    from ...engine.progress import Progress

SHEET = "Contact Sheet"
"""Name of the image in the .blend."""


class FRUITLANGS_OT_check_photos(JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.check_photos"
    bl_label = "Check Photos"
    bl_description = "Check the photos for blur, gaps, exposure jumps and mixed cameras; estimate the time of a run"

    title = "Photo Check"
    _sheet: Path

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context) or context.scene is None:
            return False
        if not context.scene.fruitlangs.source:
            cls.poll_message_set("Choose the folder of the photos first")
            return False
        return True

    def prepare(self, context: bpy.types.Context) -> Work:
        settings = context.scene.fruitlangs
        self._source = source_folder(settings)
        config, photos = read_config(settings, self._source), find_true_source(self._source)
        self._sheet = Path(bpy.app.tempdir or tempfile.gettempdir()) / "fruitlangs_contact_sheet.jpg"
        return lambda progress: check(photos, config, self._sheet, progress)

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        show_check(self._target.scene(context), result, self._source)
        if result.photos:
            load_sheet(self._sheet)
        self.report({"INFO"}, summarise(result))


def check(photos: Path, config: Config, sheet: Path, progress: Progress) -> PhotoCheck:
    """The check of the photos; its contact sheet is written to `sheet`."""
    from ...engine.photo_check.check import check_photos
    from ...engine.photo_check.sheet import write_sheet

    found = check_photos(photos, config, progress=progress)
    if found.photos:
        write_sheet(sheet, found)
    return found


def summarise(found: PhotoCheck) -> str:
    """'60 photos: 0 problems, 1 warning. A run takes about 4 min and 1.1 GB'."""
    cost = (
        f". A run takes about {duration(found.seconds, ROUNDING)} and {found.bytes / 2**30:.1f} GB"
        if found.costs
        else ""
    )
    return f"{len(found.photos)} photos: {found.counts}{cost}"


def show_check(bpy_scene: bpy.types.Scene, found: PhotoCheck, source: Path) -> None:
    """Store the findings for the panel."""
    shown = bpy_scene.fruitlangs.check
    shown.summary, shown.source = summarise(found), format_stored_path(source)
    shown.findings.clear()
    for finding in found.findings:
        item = shown.findings.add()
        item.text, item.problem = finding.text, finding.severity == "problem"


def load_sheet(path: Path) -> bpy.types.Image:
    """The contact sheet as an image of the .blend, in place of an earlier one."""
    earlier = bpy.data.images.get(SHEET)
    image = bpy.data.images.load(str(path))
    image.pack()
    image.filepath_raw = f"//{path.name}"  # the temporary file is in the user's home on some systems
    for packed in image.packed_files:
        packed.filepath = image.filepath_raw
    if earlier is not None:
        earlier.user_remap(image)
        bpy.data.images.remove(earlier)
    image.name = SHEET
    return image


class FRUITLANGS_OT_show_sheet(bpy.types.Operator):
    bl_idname = "fruitlangs.show_sheet"
    bl_label = "Show Contact Sheet"
    bl_description = "Show all photos in a new window, with those of the findings framed and labelled"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return bpy.data.images.get(SHEET) is not None

    def execute(self, context: bpy.types.Context) -> set[str]:
        if bpy.app.background:
            return {"CANCELLED"}
        bpy.ops.wm.window_new()
        window = context.window_manager.windows[-1]
        area = window.screen.areas[0]
        area.ui_type = "IMAGE_EDITOR"
        area.spaces.active.image = bpy.data.images[SHEET]
        region = next(region for region in area.regions if region.type == "WINDOW")
        with context.temp_override(window=window, area=area, region=region):
            bpy.ops.image.view_all(fit_view=True)
        return {"FINISHED"}


CLASSES = (FRUITLANGS_OT_check_photos, FRUITLANGS_OT_show_sheet)
