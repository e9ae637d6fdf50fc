"""After a count: what a person decided before holds on, and the line that says where the review stands."""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np

from .blender_data import owned_object, owned_objects, remove_objects
from .fruit_objects import CONFIRMED, LAST_ID, REJECTED, REVIEW, judge, make_fruit, read_log, spot_of, standing
from .write_fruits import label_fruit

if TYPE_CHECKING:
    from ..engine.counting.fruit import FruitCount


def keep_decisions(bpy_scene: bpy.types.Scene, fruit_count: FruitCount) -> list[str]:
    """Apply the log to the fruit objects of a new count; returns what of it could not be applied, in words."""
    from ..engine.counting.review import replay

    bpy_scene[LAST_ID] = max(int(bpy_scene.get(LAST_ID, 0)), fruit_count.last_id)
    log = read_log(bpy_scene)
    root = owned_object(bpy_scene, "root")
    if not log or root is None:
        return []
    items = owned_objects(bpy_scene, "fruit")
    found = replay(log, [spot_of(item, root) for item in items])
    kept = {source for source in found.sources if source >= 0}
    for spot, verdict, source in zip(found.spots, found.standings, found.sources, strict=True):
        if source < 0:
            judge(make_fruit(bpy_scene, spot, None), verdict)
            continue
        judge(items[source], verdict)
        if items[source]["label"] != spot.label:
            label_fruit(items[source], spot.label, bpy_scene)
    remove_objects(item for index, item in enumerate(items) if index not in kept)
    return [
        f"{decision.action} of {', '.join(str(spot.id) for spot in decision.before)}: no longer found"
        for decision in found.lost
    ]


def review_line(bpy_scene: bpy.types.Scene) -> str:
    """'machine 182, after review 185, interval 178–196'; without the middle where nothing was reviewed."""
    from ..engine.counting.review import corrected_interval

    shown = bpy_scene.fruitlangs.result
    items = owned_objects(bpy_scene, "fruit")
    after = len(standing(bpy_scene))
    told = [f"machine {shown.count}"]
    if any(REVIEW in item for item in items) or len(bpy_scene.fruitlangs.review.log):
        told.append(f"after review {after}")
    if shown.high >= 0:
        own = [item for item in items if item.get(REVIEW) in (None, CONFIRMED, REJECTED)]
        chances = np.array([float(item.get("probability", 1.0)) for item in own])
        reviewed = np.array([REVIEW in item for item in own], bool)
        rejected = sum(item.get(REVIEW) == REJECTED for item in own)
        low, high = corrected_interval(shown.count, (shown.low, shown.high), chances, reviewed, rejected, after)
        told.append(f"interval {low}–{high}")
    return ", ".join(told)
