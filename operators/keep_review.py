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


def is_reviewed(bpy_scene: bpy.types.Scene) -> bool:
    """Whether a person has decided anything about its fruit."""
    return bool(len(bpy_scene.fruitlangs.review.log)) or any(
        REVIEW in item for item in owned_objects(bpy_scene, "fruit")
    )


def reviewed_interval(bpy_scene: bpy.types.Scene) -> tuple[int, int] | None:
    """90 % interval of the visible fruit, narrowed by what has been looked at; None where the count tells none."""
    from ..engine.counting.review import corrected_interval

    shown = bpy_scene.fruitlangs.result
    if shown.high < 0:
        return None
    own = [item for item in owned_objects(bpy_scene, "fruit") if item.get(REVIEW) in (None, CONFIRMED, REJECTED)]
    chances = np.array([float(item.get("probability", 1.0)) for item in own])
    reviewed = np.array([REVIEW in item for item in own], bool)
    rejected = sum(item.get(REVIEW) == REJECTED for item in own)
    after = len(standing(bpy_scene))
    return corrected_interval(shown.count, (shown.low, shown.high), chances, reviewed, rejected, after)


def review_line(bpy_scene: bpy.types.Scene) -> str:
    """'machine 182, after review 185, interval 178–196'; without the middle where nothing was reviewed."""
    interval = reviewed_interval(bpy_scene)
    return counts_line(bpy_scene) + ("" if interval is None else f", interval {interval[0]}–{interval[1]}")


def counts_line(bpy_scene: bpy.types.Scene) -> str:
    """'machine 182, after review 185'; without the second where nothing was reviewed."""
    shown = bpy_scene.fruitlangs.result
    told = [f"machine {shown.count}"] if shown.count >= 0 else []
    if is_reviewed(bpy_scene):
        told.append(f"after review {len(standing(bpy_scene))}")
    elif not told:  # a .blend that the command line wrote
        told.append(f"{len(standing(bpy_scene))} fruit")
    return ", ".join(told)


def entry_text(entry: bpy.types.PropertyGroup) -> str:
    """One decision of the log: '2026-05-01 10:00 merge 12, 15 → 121 (one apple)'."""
    numbers = [", ".join(str(spot.number) for spot in spots) for spots in (entry.before, entry.after)]
    if entry.action == "relabel":
        numbers[1] = entry.after[0].label
    told = " → ".join(number for number in numbers if number)
    reason = f" ({entry.reason})" if entry.reason else ""
    return f"{entry.time[:16].replace('T', ' ')} {entry.action} {told}{reason}"
