"""Count the prompt's fruit in the chosen scene and show them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ..engine.report.words import length_unit, nothing_found, sureness, three_digits, whereabouts
from .blender_data import owned_object
from .jobs import JobOperator, Work, running
from .settings import read_config, read_prompts, read_words, result_folder, source_folder, stored_path
from .target import Target
from .viewport import look_at_scene, show_colors, shown_screens
from .write import SET_ID, write_result


class FRUITLANGS_OT_count(JobOperator, bpy.types.Operator):
    bl_idname = "fruitlangs.count"
    bl_label = "Count Fruit"
    bl_description = "Train Gaussians from the photos, ask them the prompt and count; stages already done are reused"
    bl_options = {"UNDO"}

    title = "Count"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if running() is not None:
            cls.poll_message_set("Another job is at work; wait or cancel it first")
            return False
        if context.scene is None or not context.scene.fruitlangs.source:
            cls.poll_message_set("Choose a scene first")
            return False
        if not context.scene.fruitlangs.prompt.strip(" ,"):
            cls.poll_message_set("Type what to count, for example apple")
            return False
        return True

    def prepare(self, context: bpy.types.Context) -> Work:
        from ..engine.pipeline import count_scene

        settings = context.scene.fruitlangs
        source, out = source_folder(settings), result_folder(settings)
        prompts, negatives = read_prompts(settings), read_words(settings.negative)
        config = read_config(settings)
        opened = Path(bpy.data.filepath) if bpy.data.filepath else None
        self._target = Target(context.scene)
        return lambda progress: count_scene(
            source, prompts, out, negatives=negatives, config=config, keep=opened, progress=progress
        )

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        bpy_scene = self._target.scene(context)
        first = owned_object(bpy_scene, "root") is None
        write_result(bpy_scene, result.scene, result.gaussians, result.probability, result.fruit_count)
        bpy_scene[SET_ID] = result.set_id
        keep_result(bpy_scene.fruitlangs, result)
        show_colors(shown_screens(context))
        if first:
            look_at_scene(shown_screens(context), bpy_scene)
        self.report({"INFO"}, f"{count_text(bpy_scene.fruitlangs.result)}; files are in {result.out}")

    def failed(self, context: bpy.types.Context, message: str) -> None:
        context.scene.fruitlangs.error = message


def keep_result(settings: Any, result: Any) -> None:
    """Keep in the .blend what the panel shows of a count."""
    fruit_count, shown = result.fruit_count, settings.result
    shown.count = fruit_count.count
    shown.label = ", ".join(sorted({fruit.label for fruit in fruit_count.fruits})) or settings.prompt
    shown.unit, scale = length_unit(result.scene.metres_per_unit)
    shown.mean_diameter = (fruit_count.mean_diameter or 0.0) * scale
    shown.zero_reason = "" if fruit_count.fruits else nothing_found(fruit_count, result.config.count.threshold)
    shown.sureness = sureness(fruit_count) if fruit_count.fruits else ""
    shown.whereabouts = "; ".join(whereabouts(fruit_count)) if fruit_count.fruits else ""
    shown.notices = "; ".join(result.notices)
    shown.cameras, shown.points = len(result.scene.cameras), len(result.scene.points)
    shown.folder = stored_path(result.out)


def count_text(shown: Any) -> str:
    """'apple: 7, mean diameter 81.2 mm'."""
    if shown.count:
        return f"{shown.label}: {shown.count}, {size_text(shown)}"
    return f"{shown.label}: 0, {shown.zero_reason}"


def size_text(shown: Any) -> str:
    """'mean diameter 81.2 mm'."""
    return f"mean diameter {three_digits(shown.mean_diameter)} {shown.unit}"


CLASSES = (FRUITLANGS_OT_count,)
