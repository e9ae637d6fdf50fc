"""Counts the prompt's fruit in the chosen scene and shows them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...engine.progress import Progress
from ..jobs.jobs import Work
from ..settings.settings import (
    given_settings,
    imported_file,
    read_config,
    read_prompts,
    read_words,
    result_folder,
    source_folder,
    stored_path,
)
from .preview import Preview, SceneJob
from .show_result import report_line, show_result


class FRUITLANGS_OT_count(SceneJob, bpy.types.Operator):
    bl_idname = "fruitlangs.count"
    bl_label = "Count Fruit"
    bl_description = (
        "Train Gaussians from the photos, select those that match the prompt, and count; finished stages are reused"
    )
    bl_options = {"UNDO"}

    title = "Count"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not super().poll(context):
            return False
        if not context.scene.fruitlangs.prompt.strip(" ,"):
            cls.poll_message_set("Type what to count, for example apple")
            return False
        return True

    _out: Path

    def prepare(self, context: bpy.types.Context) -> Work:
        settings = context.scene.fruitlangs
        source, out, imported = source_folder(settings), result_folder(settings), imported_file(settings)
        prompts, negatives = read_prompts(settings), read_words(settings.negative)
        config, given = read_config(settings, source), given_settings(settings)
        opened = Path(bpy.data.filepath) if bpy.data.filepath else None
        self._out = out
        self._preview = Preview(context.scene, source)
        watch = self._preview.watch

        def work(progress: Progress) -> Any:
            from ...engine.pipeline import count_scene

            return count_scene(
                source,
                prompts,
                out,
                negatives=negatives,
                config=config,
                keep=opened,
                imported=imported,
                given=given,
                watch=watch,
                progress=progress,
            )

        return work

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        bpy_scene = self._target.scene(context)
        show_result(context, bpy_scene, result)
        bpy_scene.fruitlangs.result.work = stored_path(self._out)
        self.report({"INFO"}, f"{report_line(bpy_scene.fruitlangs.result)}; files are in {result.out}")


CLASSES = (FRUITLANGS_OT_count,)
