"""Parts that the steps of the Fruit tab share: frame, state, wrapped text, and settings."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from typing import Any, ClassVar

import bpy

from ...operators.drawing.splat_drawing import explain_problem
from ...operators.jobs.jobs import FRUITLANGS_OT_cancel, Job, find_running_job
from .steps import ICONS, Name, step_of


class SidebarPanel:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "Fruit"


class StepPanel(SidebarPanel):
    """A step of the workflow: its header shows its state, its body what it needs next."""

    step: ClassVar[Name]

    def draw_header(self: Any, context: bpy.types.Context) -> None:
        self.layout.label(text="", icon=ICONS[step_of(self.step, context.scene).state])

    def make_body(self: Any, context: bpy.types.Context) -> Any:
        """Make the layout of the panel with labels left of their values, below the sentence about what the step needs
        next."""
        self.layout.use_property_split = True
        self.layout.use_property_decorate = False
        sentence = step_of(self.step, context.scene).sentence
        if sentence and find_running_job() is None:
            draw_text(self.layout, sentence, context, icon="INFO")
        return self.layout


def draw_job(layout: Any, title: str, context: bpy.types.Context) -> bool:
    """Draw the progress of the job with that title and its Cancel button; False if it does not run, then also with the
    last error."""
    job: Job | None = find_running_job()
    if job is None or job.title != title:
        settings = context.scene.fruitlangs
        if settings.error and settings.failed == title:
            box = layout.box()
            box.alert = True
            draw_text(box, settings.error, context, icon="ERROR")
        return False
    column = layout.column()
    column.progress(factor=job.fraction, text=f"{job.title} {job.fraction:.0%}")
    draw_text(column, job.text, context)
    column.operator(FRUITLANGS_OT_cancel.bl_idname, icon="CANCEL")
    return True


def draw_text(layout: Any, text: str, context: bpy.types.Context, icon: str = "NONE") -> None:
    """Draw text wrapped to the width of the sidebar; labels do not wrap by themselves."""
    column = layout.column(align=True)
    width, indent = max(int(sidebar_width(context) / 6.3) - 6, 12), "" if icon == "NONE" else 3 * " "
    for number, line in enumerate(textwrap.wrap(text, width, initial_indent=indent)):
        column.label(text=line.strip(), icon=icon if number == 0 else "NONE")


def draw_splat_problem(layout: Any, context: bpy.types.Context) -> None:
    """Draw why splats cannot be drawn and what can be shown instead; nothing if they can."""
    if not explain_problem():
        return
    box, look = layout.box(), context.scene.fruitlangs.look
    box.alert = True
    draw_text(
        box, f"Splats cannot be drawn here ({explain_problem()}). Change Show to try again", context, icon="ERROR"
    )
    if look.style == "SPLATS":
        box.prop_enum(look, "style", "ELLIPSOIDS")


def sidebar_width(context: bpy.types.Context) -> float:
    """Width of the drawn region in pixels, at an interface scale of 1."""
    pixels: float = context.region.width / context.preferences.system.ui_scale
    return pixels


def draw_settings(layout: Any, group: Any, names: Iterable[str]) -> None:
    """Draw settings of one stage, one below the other."""
    column = layout.column(align=True)
    for name in names:
        column.prop(group, name)
