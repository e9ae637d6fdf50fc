"""Logs fruit that the user deleted or copied with Blender's own tools (X, Shift-D).

The .blend stores which fruit existed at the last check (`review.known`). Fruit missing since then were deleted:
rejected, unless they are many (`missing_fruit`). New ones were copied: added. So the log is complete, and a later count
keeps both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np

from ..blender_data import find_owned_object
from ..scene_frame import SceneFrame, scene_frame
from .fruit_objects import (
    ADDED,
    LAST_ID,
    choose_new_ids,
    format_now,
    fruit_frame,
    is_made,
    judge,
    keep_spot,
    list_counted_fruit,
    spot_of,
    spots_of,
    write_log,
)
from .missing_fruit import check_missing, keep_details, reject_missing
from .write_fruits import label_fruit

if TYPE_CHECKING:
    from ...engine.counting.accounts.review import Spot

OF_ONE_COUNT = ("probability", "visible_fraction", "diameter_sd", "views", "kind")
"""Custom properties of a counted fruit that a copy of it does not get."""


def remember_fruit(bpy_scene: bpy.types.Scene) -> None:
    """Store which fruit exist and where; counted ones at the position of the count, so that a later count finds
    them."""
    if find_owned_object(bpy_scene, "root") is None:
        return
    frame, known = scene_frame(bpy_scene), bpy_scene.fruitlangs.review.known
    found = {spot.id: spot for spot in spots_of(known)}
    spots = []
    for item in list_counted_fruit(bpy_scene):
        before = found.get(int(item.get("id", 0)))
        spots.append((spot_of(item, frame) if before is None or is_made(item) else before, item))
    known.clear()
    for spot, item in spots:
        keep_details(keep_spot(known, spot), item)


def log_copies(bpy_scene: bpy.types.Scene) -> list[str]:
    """Log which fruit were copied since `remember_fruit`; returns it as texts."""
    from ...engine.counting.accounts.review import Decision

    if find_owned_object(bpy_scene, "root") is None:
        return []
    frame, known = fruit_frame(bpy_scene), spots_of(bpy_scene.fruitlangs.review.known)
    items, notices = _find_originals(bpy_scene, frame, known), []
    own = set(items.values())
    copies = [item for item in list_counted_fruit(bpy_scene) if item not in own]
    for item, number in zip(copies, choose_new_ids(bpy_scene, len(copies)), strict=True):
        _make_own(bpy_scene, item, number)
        spot = spot_of(item, frame)
        write_log(bpy_scene, Decision("add", format_now(), "copied", after=(spot,)))
        if known:
            keep_details(keep_spot(bpy_scene.fruitlangs.review.known, spot), item)
    if copies:
        notices.append(f"copied by hand and added in the log: {_join_numbers([item['id'] for item in copies])}")
    return notices


def log_deletions(bpy_scene: bpy.types.Scene) -> list[str]:
    """Log which fruit were deleted since `remember_fruit`; returns it as texts.

    Fruit that were never stored are not logged, nor are fruit whose root is gone: deleting a whole scene is not a
    review.

    Raises:
        CountingError: many were deleted or unlinked, which may be an accident.
    """
    check_missing(bpy_scene)
    missing = reject_missing(bpy_scene)
    remember_fruit(bpy_scene)
    return (
        [f"deleted by hand and rejected in the log: {_join_numbers([spot.id for spot in missing])}"] if missing else []
    )


def _find_originals(bpy_scene: bpy.types.Scene, frame: SceneFrame, known: list[Spot]) -> dict[int, bpy.types.Object]:
    """Return {id: object} of the stored fruit; of several with one id the nearest to the stored position.

    Without a stored position it is the first of each id.
    """
    centers, found = {spot.id: spot.center for spot in known}, dict[int, tuple[float, bpy.types.Object]]()
    for item in sorted(list_counted_fruit(bpy_scene), key=lambda item: item.name):
        number = int(item.get("id", 0))
        if known and number not in centers:
            continue
        place = spot_of(item, frame).center
        away = float(np.linalg.norm(place - centers.get(number, place)))
        if number not in found or away < found[number][0]:
            found[number] = (away, item)
    return {number: item for number, (_, item) in found.items()}


def _make_own(bpy_scene: bpy.types.Scene, item: bpy.types.Object, number: int) -> None:
    """Make a copy a fruit of its own, as if the user had added it; selection and active object stay."""
    for key in OF_ONE_COUNT:
        if key in item:
            del item[key]
    item["id"] = bpy_scene[LAST_ID] = number
    judge(item, ADDED)
    label_fruit(item, str(item.get("label", "fruit")), bpy_scene)


def _join_numbers(numbers: list[int]) -> str:
    return ", ".join(map(str, sorted(numbers)))
