"""The settings panels below a step, generated from the engine's configs: common, advanced and experimental settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import bpy

from ...engine.config import STAGES
from ...engine.setting import LEVELS, Level, level_of
from ...operators.jobs.jobs import find_running_job
from .panel_parts import SidebarPanel, draw_settings

HEADINGS = {"scene": "Photos", "photos": "Camera Search", "embed": "Features", "count": "Counting", "units": "Scale"}
LABELS: dict[Level, str] = {"common": "Settings", "advanced": "Advanced", "experimental": "Experimental"}


def make_settings_panels(step: type, stages: Sequence[str]) -> tuple[type, ...]:
    """Make panels, closed at first, with the settings of some stages: common ones below `step`, the others below
    these."""
    panels: list[type] = []
    for level in LEVELS:
        names = {stage: settings_of(stage, level) for stage in stages}
        if any(names.values()):
            panels.append(_make_panel(panels[0] if panels else step, level, names))
    return tuple(panels)


def settings_of(stage: str, level: Level) -> list[str]:
    """Names of the settings of a stage and level."""
    return [setting.name for setting in fields(STAGES[stage]) if level_of(setting) == level]


def _make_panel(parent: type, level: Level, names: dict[str, list[str]]) -> type:
    """Make the panel of one level below `parent`; names: {stage: its settings}."""

    def draw(self: bpy.types.Panel, context: bpy.types.Context) -> None:
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.enabled = find_running_job() is None
        shown = {stage: settings for stage, settings in names.items() if settings}
        for stage, settings in shown.items():
            if len(shown) > 1:
                layout.label(text=HEADINGS[stage])
            draw_settings(layout, getattr(context.scene.fruitlangs.config, stage), settings)

    name = f"{parent.__name__.removesuffix('_settings')}_{'settings' if level == 'common' else level}"
    content: dict[str, Any] = {
        "__doc__": f"{LABELS[level]} below a step.",
        "__module__": __name__,
        "bl_idname": name,
        "bl_label": LABELS[level],
        "bl_parent_id": parent.__name__,
        "bl_options": {"DEFAULT_CLOSED"},
        "draw": draw,
    }
    return type(name, (SidebarPanel, bpy.types.Panel), content)
