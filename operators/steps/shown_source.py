"""The source of the shown scene, its review and its measurements; those of another source are put away."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
from mathutils import Matrix

from ..blender_data import find_owned_object, find_owned_objects, remove_objects
from ..data.photo_files import remove_backgrounds
from ..data.stored_audit import AUDIT
from ..data.stored_review import describe_kept, keep_last_corrections
from ..data.write import SET_ID
from ..data.write_root import GROUND, METRES
from ..root_placement import place_root, placement_of, root_frame
from ..scene_frame import SceneFrame
from ..settings.settings import (
    MEASURES,
    find_true_source,
    format_stored_path,
    is_of_another,
    is_same_source,
    resolve_known_path,
)
from ..settings.source_mark import source_mark

OF_SOURCE = ("source", "mark", "work")
"""What the result keeps of its source, whether or not it was counted."""


def enter_source(bpy_scene: bpy.types.Scene, source: Path) -> list[str]:
    """Make this Blender scene show `source`; data of another source are put away, which is returned as texts.

    Decisions are kept until their source is shown again; objects, count and measurements are removed.
    """
    settings, notices = bpy_scene.fruitlangs, []
    if is_of_another(settings, source):
        notices = _leave_source(bpy_scene)
    true, review = find_true_source(source), settings.review
    settings.result.source = format_stored_path(true)
    settings.result.mark = source_mark(true) or settings.result.mark
    for index in reversed(range(len(review.aside))):
        kept = review.aside[index]
        known = resolve_known_path(kept.source)
        if known is not None and is_same_source(known, kept.mark, source):
            _move_log(kept.log, review.log)
            review.aside.remove(index)
    return notices


def _leave_source(bpy_scene: bpy.types.Scene) -> list[str]:
    settings, root = bpy_scene.fruitlangs, find_owned_object(bpy_scene, "root")
    source = resolve_known_path(settings.result.source)
    notices = forget_count(bpy_scene)
    decisions = len(settings.review.log)
    if decisions:
        kept = settings.review.aside.add()
        kept.source, kept.mark = settings.result.source, settings.result.mark
        _move_log(settings.review.log, kept.log)
    measured = _forget_measures(bpy_scene) or find_owned_object(bpy_scene, "region") is not None
    frame = root_frame(bpy_scene)
    placed = frame is not None and placement_of(frame) is not None
    remove_backgrounds(find_owned_objects(bpy_scene, "camera"))
    for role in ("gaussians", "points", "region", "camera"):
        remove_objects(find_owned_objects(bpy_scene, role))
    if root is not None:
        root[METRES] = 0.0
        place_root(SceneFrame(root, Matrix()), Matrix(), None)
    for name in OF_SOURCE:
        settings.result.property_unset(name)
    if decisions:
        notices.append(f"{describe_kept(decisions, str(source))} until it is shown again")
    if measured:
        notices.append(
            f"the scale, ground and region of {source} were removed, because they do not apply to this scene"
        )
    if placed:
        notices.append(f"the tree stands over the origin, because its placement was that of {source}")
    return notices


def forget_count(bpy_scene: bpy.types.Scene) -> list[str]:
    """Remove the fruit and the answer with their texts in the panel; decisions stay in the log. Returns what was
    logged or could not be, as texts."""
    notices = keep_last_corrections(bpy_scene)
    remove_objects(find_owned_objects(bpy_scene, "fruit"))
    settings = bpy_scene.fruitlangs
    settings.review.known.clear()
    for group in (settings.result, settings.answer):
        for each in group.bl_rna.properties:
            if each.identifier not in {"rna_type", "name", *OF_SOURCE}:
                group.property_unset(each.identifier)
    bpy_scene.pop(SET_ID, None)
    bpy_scene.pop(AUDIT, None)
    return notices


def _forget_measures(bpy_scene: bpy.types.Scene) -> bool:
    """Reset the measurements; False if there were none."""
    config, measured = bpy_scene.fruitlangs.config, GROUND in bpy_scene
    bpy_scene.pop(GROUND, None)
    for stage, names in MEASURES.items():
        group = getattr(config, stage)
        for name in names:
            measured |= group.is_property_set(name)
            group.property_unset(name)
    return measured


def _move_log(old: Any, new: Any) -> None:
    """Append the entries of one log to another."""
    for entry in old:
        copy = new.add()
        copy.action, copy.time, copy.reason = entry.action, entry.time, entry.reason
        for spots, kept in ((entry.before, copy.before), (entry.after, copy.after)):
            for spot in spots:
                row = kept.add()
                row.number, row.label = spot.number, spot.label
                row.center, row.axes = tuple(spot.center), tuple(spot.axes)
    old.clear()
