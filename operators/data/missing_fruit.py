"""Fruit that were deleted or unlinked since the last check, and how they come back.

One deleted fruit is a rejection. Many at once are more often an accident, for example a deleted collection: they are no
decision until the user rejects or restores them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import bpy

from ...engine.errors import CountingError
from ..blender_data import ensure_owned_collection, find_owned_object, find_owned_objects, find_unlinked_fruit
from ..viewport.fruit_colours import colour_fruit
from .fruit_objects import (
    REJECTED,
    REVIEW,
    format_now,
    is_made,
    judge,
    list_counted_fruit,
    make_fruit,
    spots_of,
    write_log,
)
from .write_fruits import put_on_tree

if TYPE_CHECKING:
    from ...engine.counting.accounts.review import Spot

FEW = 3
"""Number of fruit that may be missing at once and are rejected without a question."""
SHARE = 0.1
"""Share of the fruit above which more than `FEW` missing ones are a question: less than a tree of a row has."""
PLAIN = (bool, int, float, str, list)
"""Types of custom properties of fruit; renderers add others."""
DELETED = "deleted"
"""Reason in the log of fruit that were deleted by hand."""


def find_missing_fruit(bpy_scene: bpy.types.Scene) -> list[Spot]:
    """Find the fruit of the last check that are not in this Blender scene any more; none if its root is gone too."""
    return spots_of(_find_missing_rows(bpy_scene))


def count_many_missing(bpy_scene: bpy.types.Scene) -> int:
    """Count the missing fruit, if they are too many for a decision; else 0."""
    missing = len(_find_missing_rows(bpy_scene))
    return missing if missing > max(FEW, SHARE * len(bpy_scene.fruitlangs.review.known)) else 0


def _find_missing_rows(bpy_scene: bpy.types.Scene) -> list[Any]:
    if find_owned_object(bpy_scene, "root") is None:
        return []
    present = {int(item.get("id", 0)) for item in list_counted_fruit(bpy_scene)}
    return [row for row in bpy_scene.fruitlangs.review.known if row.number not in present]


def describe_missing(bpy_scene: bpy.types.Scene) -> str:
    """Say '117 of 117 fruit were deleted or unlinked'; empty if none or few were."""
    missing = count_many_missing(bpy_scene)
    return f"{missing} of {len(bpy_scene.fruitlangs.review.known)} fruit were deleted or unlinked" if missing else ""


def check_missing(bpy_scene: bpy.types.Scene) -> None:
    """Refuse to go on while many fruit are missing.

    Raises:
        CountingError: many fruit were deleted or unlinked since the last check.
    """
    text = describe_missing(bpy_scene)
    if text:
        raise CountingError(
            f"{text}. Undo, or press Restore Fruit or Reject Missing in step 5 (in a script: "
            "bpy.ops.fruitlangs.restore_fruit() or reject_missing())"
        )


def reject_missing(bpy_scene: bpy.types.Scene, reason: str = DELETED) -> list[Spot]:
    """Log all missing fruit as rejected, and return them."""
    from ...engine.counting.accounts.review import Decision

    missing = find_missing_fruit(bpy_scene)
    if missing:
        write_log(bpy_scene, Decision("reject", format_now(), reason, before=tuple(missing)))
    return missing


def restore_missing(bpy_scene: bpy.types.Scene) -> int:
    """Bring the missing fruit back where they were at the last check, and return their number.

    Unlinked objects are linked again; deleted ones are made from what `keep_details` stored.

    Raises:
        CountingError: a file of an earlier version does not have these details.
    """
    missing = {spot.id: spot for spot in find_missing_fruit(bpy_scene)}
    details = {row.number: row.details for row in bpy_scene.fruitlangs.review.known}
    root = find_owned_object(bpy_scene, "root")
    assert root is not None
    unlinked = {int(item.get("id", 0)): item for item in find_unlinked_fruit(root)}
    if any(not details[number] for number in missing if number not in unlinked):
        raise CountingError("The deleted fruit are not stored in this file. Undo, or import the result again")
    fruits = ensure_owned_collection(bpy_scene, "fruits", "Fruits")
    for number, spot in missing.items():
        if number in unlinked:
            fruits.objects.link(unlinked[number])
        else:
            _set_details(make_fruit(bpy_scene, spot, None), details[number], bpy_scene)
    return len(missing)


def keep_details(row: Any, item: bpy.types.Object) -> None:
    """Store the custom properties of a fruit with its spot in `review.known`."""
    values = {key: value.to_list() if hasattr(value, "to_list") else value for key, value in item.items()}
    row.details = json.dumps({key: value for key, value in values.items() if isinstance(value, PLAIN)})


def _set_details(item: bpy.types.Object, details: str, bpy_scene: bpy.types.Scene) -> None:
    for key in list(item.keys()):
        del item[key]
    for key, value in json.loads(details).items():
        item[key] = value
    colour_fruit(item)
    put_on_tree(bpy_scene, item)
    item.hide_viewport = item.hide_render = False


def describe_rejected(bpy_scene: bpy.types.Scene) -> str:
    """Say 'the review rejects 117 of 117 fruit'; empty unless it rejects more than half of them, and more than
    `FEW`."""
    counted = [item for item in find_owned_objects(bpy_scene, "fruit") if not is_made(item)]
    rejected = sum(item.get(REVIEW) == REJECTED for item in counted)
    return f"the review rejects {rejected} of {len(counted)} fruit" if rejected > max(FEW, len(counted) // 2) else ""


def reopen_rejected(bpy_scene: bpy.types.Scene, spots: Sequence[Spot]) -> int:
    """Undo the rejection of all fruit that exist, with their `spots` for the log, and return their number."""
    from ...engine.counting.accounts.review import Decision

    items = [item for item in find_owned_objects(bpy_scene, "fruit") if item.get(REVIEW) == REJECTED]
    write_log(bpy_scene, Decision("reopen", format_now(), "", before=tuple(spots)))
    for item in items:
        judge(item, "")
    return len(items)
