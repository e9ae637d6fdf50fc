"""Counts the prompt's fruit in the chosen scene and shows them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from ...engine.progress import Progress
from ..jobs.jobs import Work
from ..settings.settings import format_stored_path, read_prompts, read_words
from .preview import SceneJob
from .show_result import make_count_report, show_result


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

    def prepare(self, context: bpy.types.Context) -> Work:
        settings = context.scene.fruitlangs
        run = self.read_run(context)
        prompts, negatives = read_prompts(settings), read_words(settings.negative)
        opened = Path(bpy.data.filepath) if bpy.data.filepath else None

        def work(progress: Progress) -> Any:
            from ...engine.pipeline import count_scene

            return count_scene(
                run.source,
                prompts,
                run.out,
                negatives=negatives,
                config=run.config,
                keep=opened,
                imported=run.imported,
                given=run.given,
                watch=run.watch,
                progress=progress,
            )

        return work

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        bpy_scene = self._target.scene(context)
        show_result(context, bpy_scene, result)
        bpy_scene.fruitlangs.result.work = format_stored_path(self._out)
        level, text = make_count_report(bpy_scene.fruitlangs.result, result.fruit_count)
        self.report(level, f"{text}; files are in {result.out}")


CLASSES = (FRUITLANGS_OT_count,)
