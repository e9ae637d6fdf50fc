"""The audit of the active fruit, and the dropped clusters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.report.words import audit_reason, place
from ...operators.blender_data import OWNER
from ...operators.data.fruit_objects import is_made, metres_per_unit
from ...operators.data.stored_audit import read_audit, select_about_fruit
from ...operators.review.show_cluster import FRUITLANGS_OT_look_at_cluster
from .panel_parts import SidebarPanel, draw_text

if TYPE_CHECKING:
    from ...engine.counting.fruit import AuditEntry

ROWS = 6
"""Dropped clusters that the panel shows at a time."""


class FRUITLANGS_PT_review_why(SidebarPanel, bpy.types.Panel):
    bl_idname = "FRUITLANGS_PT_review_why"
    bl_label = "Audit"
    bl_parent_id = "FRUITLANGS_PT_review"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        audit, metres = read_audit(context.scene), metres_per_unit(context.scene)
        if not audit:
            draw_text(self.layout, "No audit here. Count again or import the result", context)
            return
        for text in texts_of_active(context.view_layer.objects.active, audit, metres):
            draw_text(self.layout, text, context)
        _draw_dropped(self.layout, [entry for entry in audit if entry.verdict == "dropped"], metres, context)


def _draw_dropped(layout: Any, dropped: Sequence[AuditEntry], metres: float | None, context: bpy.types.Context) -> None:
    """The dropped clusters, largest first, starting at the one set in the review."""
    review = context.scene.fruitlangs.review
    layout.label(text=f"{len(dropped)} dropped clusters, largest first" if dropped else "No cluster was dropped")
    if len(dropped) > ROWS:
        layout.prop(review, "dropped")
    first = min(review.dropped - 1, max(len(dropped) - ROWS, 0))
    for entry in dropped[first : first + ROWS]:
        _draw_cluster(layout.box(), entry, metres, context)


def _draw_cluster(box: Any, entry: AuditEntry, metres: float | None, context: bpy.types.Context) -> None:
    row = box.row()
    row.label(text=f"{entry.points} points")
    if place(entry) is not None:
        row.operator(FRUITLANGS_OT_look_at_cluster.bl_idname, icon="VIEWZOOM").cluster = entry.cluster
    draw_text(box, audit_reason(entry, metres), context)


def texts_of_active(item: Any, audit: Sequence[AuditEntry], metres_per_unit: float | None) -> list[str]:
    """The audit of the active object, one text per cluster: 'split, 3287 points, fruit 16, 17: …'."""
    if item is None or item.get(OWNER) != "fruit":
        return ["Select a fruit to see why it was counted"]
    if is_made(item):
        return [f"{item.name} was added by the user"]
    return [_entry_text(entry, metres_per_unit) for entry in select_about_fruit(audit, int(item.get("id", 0)))] or [
        f"The audit has no entry for {item.name}"
    ]


def _entry_text(entry: AuditEntry, metres_per_unit: float | None) -> str:
    numbers = ", ".join(map(str, entry.fruit_ids))
    return f"{entry.verdict}, {entry.points} points, fruit {numbers}: {audit_reason(entry, metres_per_unit)}"
