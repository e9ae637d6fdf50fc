"""Exports the reviewed fruit: a table for spreadsheets, meshes for other 3D programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.progress import Progress
from ...engine.storage.files import write_text
from ..data.fruit_objects import metres_per_unit
from ..data.read_cameras import read_up
from .export_file import ExportFile, Write
from .export_pictures import FRUITLANGS_OT_export_report, FRUITLANGS_OT_export_still
from .export_usd import FRUITLANGS_OT_export_usd

if TYPE_CHECKING:
    from ...engine.counting.fruit import FruitCount


class FRUITLANGS_OT_export_csv(ExportFile, bpy.types.Operator):
    bl_idname = "fruitlangs.export_csv"
    bl_label = "Export Table"
    bl_description = "Write a table (.csv) with one row per fruit of the reviewed count"

    suffixes = (".csv",)

    def prepare_write(self, context: bpy.types.Context, fruit_count: FruitCount) -> Write:
        scale = metres_per_unit(context.scene)

        def write(path: Path, progress: Progress) -> None:
            from ...engine.report.tables import fruits_csv

            write_text(path, fruits_csv(fruit_count, metres_per_unit=scale))

        return write


class ExportMeshes(ExportFile):
    """Mix-in of operators that write the fruit as upright ellipsoids, in metres if the scale is known."""

    writer = ""
    """The function of `engine.report.meshes` that writes it."""

    def prepare_write(self, context: bpy.types.Context, fruit_count: FruitCount) -> Write:
        scale, up, name = metres_per_unit(context.scene), read_up(context.scene), self.writer

        def write(path: Path, progress: Progress) -> None:
            from ...engine.report import meshes

            getattr(meshes, name)(path, fruit_count, scale, up=up)

        return write


class FRUITLANGS_OT_export_glb(ExportMeshes, bpy.types.Operator):
    bl_idname = "fruitlangs.export_glb"
    bl_label = "Export glTF"
    bl_description = "Write a .glb with one named mesh per fruit, with its number, size and probability"

    suffixes = (".glb",)
    writer = "write_glb"


class FRUITLANGS_OT_export_obj(ExportMeshes, bpy.types.Operator):
    bl_idname = "fruitlangs.export_obj"
    bl_label = "Export OBJ"
    bl_description = "Write an .obj with one object per fruit, and an .mtl with its colours"

    suffixes = (".obj",)
    writer = "write_obj"


class FRUITLANGS_OT_export_ply(ExportMeshes, bpy.types.Operator):
    bl_idname = "fruitlangs.export_ply"
    bl_label = "Export PLY"
    bl_description = "Write one mesh (.ply) of all fruit, with colour and fruit number per vertex"

    suffixes = (".ply",)
    writer = "write_fruit_meshes_ply"


class FRUITLANGS_MT_export(bpy.types.Menu):
    bl_idname = "FRUITLANGS_MT_export"
    bl_label = "Fruit (FruitLangs)"

    def draw(self, context: bpy.types.Context) -> None:
        for item, text in NAMES.items():
            self.layout.operator(item.bl_idname, text=text)


NAMES: dict[Any, str] = {
    FRUITLANGS_OT_export_report: "Report (.html)",
    FRUITLANGS_OT_export_still: "Still (.jpg/.png)",
    FRUITLANGS_OT_export_csv: "Table (.csv)",
    FRUITLANGS_OT_export_glb: "glTF (.glb)",
    FRUITLANGS_OT_export_usd: "USD (.usdc)",
    FRUITLANGS_OT_export_obj: "OBJ (.obj)",
    FRUITLANGS_OT_export_ply: "PLY (.ply)",
}
"""Texts of buttons and menu entries."""


def menu_entry(self: Any, context: bpy.types.Context) -> None:
    """File > Export."""
    self.layout.menu(FRUITLANGS_MT_export.bl_idname)


CLASSES = (*NAMES, FRUITLANGS_MT_export)
