"""Trains Gaussians from the chosen scene's photos, or imports those of another program, and shows them."""

from __future__ import annotations

from typing import Any

import bpy

from ...engine.progress import Progress
from ..jobs.jobs import Work
from ..settings.settings import format_stored_path
from .preview import SceneJob
from .show_result import show_reconstruction


class FRUITLANGS_OT_reconstruct(SceneJob, bpy.types.Operator):
    bl_idname = "fruitlangs.reconstruct"
    bl_label = "Reconstruct"
    bl_description = "Train Gaussians from the photos, with features that prompts can query; finished stages are reused"
    bl_options = {"UNDO"}

    title = "Reconstruct"

    def prepare(self, context: bpy.types.Context) -> Work:
        run = self.read_run(context)

        def work(progress: Progress) -> Any:
            from ...engine.pipeline import reconstruct_scene

            return reconstruct_scene(
                run.source,
                run.out,
                config=run.config,
                imported=run.imported,
                given=run.given,
                watch=run.watch,
                progress=progress,
            )

        return work

    def finish(self, context: bpy.types.Context, result: Any) -> None:
        made, log = result
        bpy_scene = self._target.scene(context)
        notices = show_reconstruction(context, bpy_scene, made, log)
        bpy_scene.fruitlangs.result.work = format_stored_path(self._out)
        again = f", reused: {', '.join(log.reused)}" if log.reused else ""
        self.report({"INFO"}, "; ".join([f"{len(made.gaussians):,} Gaussians{again}", *notices]))


CLASSES = (FRUITLANGS_OT_reconstruct,)
