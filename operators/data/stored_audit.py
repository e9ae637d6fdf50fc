"""The audit of a count in the .blend: why each cluster of points was kept, split, merged or dropped.

It is text in a custom property of the Blender scene, because the command line writes scene.blend without the
extension's own properties.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import bpy

if TYPE_CHECKING:
    from ...engine.counting.fruit import AuditEntry

AUDIT = "fruitlangs_audit"
"""Custom property of the Blender scene: a JSON list of the audit's entries, lengths in scene units, largest first."""


def write_audit(bpy_scene: bpy.types.Scene, audit: Sequence[AuditEntry]) -> None:
    """Replace the audit of this Blender scene."""
    largest_first = sorted(audit, key=lambda entry: (-entry.points, entry.cluster))
    bpy_scene[AUDIT] = json.dumps([dataclasses.asdict(entry) for entry in largest_first])


def read_audit(bpy_scene: bpy.types.Scene) -> list[AuditEntry]:
    """The entries of the shown count, largest first; none if the .blend has no audit."""
    return list(_parse_entries(bpy_scene.get(AUDIT, "[]")))


@lru_cache(maxsize=2)  # a panel needs it at every redraw
def _parse_entries(text: str) -> tuple[AuditEntry, ...]:
    from ...engine.counting.fruit import AuditEntry

    return tuple(
        AuditEntry(**{**entry, "center": tuple(entry["center"]), "fruit_ids": tuple(entry["fruit_ids"])})
        for entry in json.loads(text)
    )


def select_about_fruit(audit: Sequence[AuditEntry], number: int) -> list[AuditEntry]:
    """Select the entries that name the fruit of that id: its own cluster first, then those merged into it."""
    return sorted((entry for entry in audit if number in entry.fruit_ids), key=lambda entry: entry.verdict == "merged")
