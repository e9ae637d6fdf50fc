"""The fruit objects of a Blender scene for the review: their positions, and the user's decisions."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import SceneError
from ...engine.report.words import format_three_digits
from ..blender_data import (
    OWNER,
    find_owned_object,
    find_owned_objects,
    list_local_collections,
    read_gaussian_attributes,
    set_attribute,
)
from ..scene_frame import REMEDY, SceneFrame, read_stored_pose, scene_frame
from .fruit_shape import fruit_ellipsoid
from .write_fruits import LENGTHS, MADE, REJECTED, REVIEW, write_fruit

if TYPE_CHECKING:
    from ...engine.counting.accounts.review import Decision, Spot

CONFIRMED, ADDED = "confirmed", "added"
"""Values of `REVIEW` in addition to `REJECTED`; 'added' if the user made the fruit, which stays in `MADE` when it is
rejected."""
LAST_ID = "fruitlangs_last_id"
"""Custom property of the Blender scene: the highest id that a fruit ever had in it."""
SAME = 1e-3
"""Relative difference between a fruit's diameter and its stored one above which the user must have scaled it."""
EDITED = 0.01
"""Change of position or length above which the user edited a fruit by hand, in its lengths."""
MOVED = 0.25
"""Distance from where it was counted above which a fruit was moved, in its smallest diameters."""
LEAST_TOGETHER = 3
"""Least number of counted fruit of which more than half may not have moved."""


def fruit_collection(bpy_scene: bpy.types.Scene) -> bpy.types.Collection | None:
    """The collection of the fruit objects, or that of the first of them if the user removed it; None without fruit."""
    first = find_owned_object(bpy_scene, "fruit")
    if first is None:
        return None
    made = (each for each in list_local_collections(bpy_scene) if each.get(OWNER) == "fruits")
    return next(made, first.users_collection[0])


def list_counted_fruit(bpy_scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """List the fruit that count: all that are not rejected."""
    return [item for item in find_owned_objects(bpy_scene, "fruit") if item.get(REVIEW) != REJECTED]


def metres_per_unit(bpy_scene: bpy.types.Scene) -> float | None:
    """Metres per unit of the scene frame; None if the scale is unknown."""
    root = find_owned_object(bpy_scene, "root")
    return None if root is None else float(root.get("metres_per_unit", 0.0)) or None


def diameter_text(item: bpy.types.Object, metric: bool) -> str:
    """A fruit's diameter for people: '81.2 mm' where lengths are metres (`metres_per_unit`), else '0.0812'."""
    return f"{diameter_number(item, metric)} mm" if metric else diameter_number(item, metric)


def diameter_number(item: bpy.types.Object, metric: bool) -> str:
    """The same without a unit, for a column below `diameter_head`."""
    return format_three_digits(float(item.get("diameter", 0.0)) * (1000.0 if metric else 1.0))


def diameter_head(metric: bool) -> str:
    """The heading of diameters without a unit."""
    return "Ø mm" if metric else "Ø units"


def spot_of(item: bpy.types.Object, frame: SceneFrame) -> Spot:
    """The position of a fruit object, in the scene frame and units.

    Raises:
        CountingError: its mesh is no ellipsoid.
        SceneError: the scene frame is unknown.
    """
    from ...engine.counting.accounts.review import Spot

    found = fruit_ellipsoid(item, frame)
    return Spot(int(item.get("id", 0)), str(item.get("label", "fruit")), found.center, found.axes)


def fruit_frame(bpy_scene: bpy.types.Scene) -> SceneFrame:
    """The scene frame for the fruit of this Blender scene.

    Raises:
        CountingError: the user scaled or moved a fruit so that it cannot be one, or edited its mesh.
        SceneError: it is unknown, or more than half of the counted fruit are not where they were counted: what moved
            them together, away from the cameras, was no correction of fruit.
    """
    frame, fruits = scene_frame(bpy_scene), find_owned_objects(bpy_scene, "fruit")
    counted = _select_written(fruits)
    moved = [item for item in counted if _is_moved(item, frame)]
    if len(counted) >= LEAST_TOGETHER and 2 * len(moved) > len(counted):
        raise SceneError(
            f"{len(moved)} of {len(counted)} fruit are not where they were counted, so places and sizes are unknown. "
            f"{REMEDY}"
        )
    for item in fruits:
        if item.get(REVIEW) != REJECTED:
            _check_edited(bpy_scene, item, frame)
    return frame


def _is_moved(item: bpy.types.Object, frame: SceneFrame) -> bool:
    """Whether a fruit is away from where it was written."""
    pose = read_stored_pose(item)
    if pose is None:
        return False
    away = float(np.linalg.norm(fruit_ellipsoid(item, frame).center - pose[:3, 3]))
    return away > MOVED * float(np.linalg.norm(pose[:3, :3], axis=0).min())


def count_edited(bpy_scene: bpy.types.Scene, frame: SceneFrame) -> int:
    """How many counted fruit the user moved or scaled by hand and did not reject."""
    return sum(_is_edited(item, frame) for item in _select_written(list_counted_fruit(bpy_scene)))


def _select_written(items: list[bpy.types.Object]) -> list[bpy.types.Object]:
    """Select the fruit that a count made, whose pose it stored."""
    return [item for item in items if read_stored_pose(item) is not None and not is_made(item)]


def _is_edited(item: bpy.types.Object, frame: SceneFrame) -> bool:
    """Whether a fruit has another position or size than it was written with."""
    pose, found = read_stored_pose(item), fruit_ellipsoid(item, frame)
    assert pose is not None
    lengths = np.sort(np.linalg.norm(pose[:3, :3], axis=0))[::-1]
    grown = np.abs(2.0 * np.linalg.norm(found.axes, axis=1) - lengths).max()
    away = np.linalg.norm(found.center - pose[:3, 3])
    return bool(max(grown, away) > EDITED * lengths.max())


def _check_edited(bpy_scene: bpy.types.Scene, item: bpy.types.Object, frame: SceneFrame) -> None:
    """Refuse a fruit that the user moved or scaled if it cannot be one any more; one without a size is an error only
    where the size counts."""
    spot = spot_of(item, frame)
    scaled = _is_scaled(bpy_scene, item, spot) and spot.diameter > 0.0
    if scaled or _is_moved(item, frame):
        check_made(bpy_scene, item.name, spot.center, spot.diameter if scaled else None)


def _is_scaled(bpy_scene: bpy.types.Scene, item: bpy.types.Object, spot: Spot) -> bool:
    """Whether the size of a fruit differs from its stored one."""
    now_metres = spot.diameter * (metres_per_unit(bpy_scene) or 1.0)
    return abs(now_metres - float(item.get("diameter", 0.0))) > SAME * now_metres


def check_made(bpy_scene: bpy.types.Scene, name: str, center: NDArray[np.float64], diameter: float | None) -> None:
    """Refuse a position (3,) and a diameter, scene units, that no fruit of this scene has. diameter: None if it was not
    changed.

    Raises:
        CountingError: it is far outside the tree, or much larger or smaller than the others.
    """
    from ...engine.counting.accounts.plausible import check_position, check_size

    frame = scene_frame(bpy_scene)
    cameras = [frame.of(item).translation for item in find_owned_objects(bpy_scene, "camera")]
    check_position(name, center, np.array(cameras, np.float64).reshape(-1, 3))
    if diameter is not None:
        check_size(name, diameter, find_usual_diameter(bpy_scene))


def find_usual_diameter(bpy_scene: bpy.types.Scene) -> float:
    """Return the median diameter of the current fruit, else of the rejected ones, scene units; 0 without any."""
    unit = metres_per_unit(bpy_scene) or 1.0
    items = list_counted_fruit(bpy_scene) or find_owned_objects(bpy_scene, "fruit")
    sizes = [float(item["diameter"]) / unit for item in items if "diameter" in item]
    return float(np.median(sizes)) if sizes else 0.0


def keep_sizes(bpy_scene: bpy.types.Scene, frame: SceneFrame) -> None:
    """Store the size of each fruit that the user scaled in its custom properties, which the list and the labels show.

    The measured uncertainty does not apply to such a size.
    """
    unit = metres_per_unit(bpy_scene) or 1.0
    for item in find_owned_objects(bpy_scene, "fruit"):
        spot = spot_of(item, frame)
        if _is_scaled(bpy_scene, item, spot):
            item["diameter"] = spot.diameter * unit
            for key, axis in zip(LENGTHS, spot.axes, strict=True):
                item[key] = 2.0 * float(np.linalg.norm(axis)) * unit
            item.pop("diameter_sd", None)


def is_made(item: bpy.types.Object) -> bool:
    """Whether the user made a fruit: it was added, copied, or is a part or the result of a split or merge."""
    return MADE in item or item.get(REVIEW) == ADDED


def judge(item: bpy.types.Object, verdict: str) -> None:
    """Mark a fruit as 'confirmed', 'rejected' or 'added', or remove the mark (''); rejected ones are hidden.

    A fruit that the user made is 'added' whenever it is not rejected, as in `replay`.
    """
    if verdict == ADDED or is_made(item):
        item[MADE] = True
        verdict = REJECTED if verdict == REJECTED else ADDED
    if REJECTED in (verdict, item.get(REVIEW)):  # what else the user hides stays hidden
        item.hide_viewport = item.hide_render = verdict == REJECTED
    if verdict:
        item[REVIEW] = verdict
    elif REVIEW in item:
        del item[REVIEW]


def make_fruit(bpy_scene: bpy.types.Scene, spot: Spot, like: bpy.types.Object | None) -> bpy.types.Object:
    """Make an object for a fruit that the user made; its colour and tree are those of the fruit `like`."""
    from ...engine.counting.fruit import Fruit

    frame = scene_frame(bpy_scene)
    color = np.array([200, 60, 40]) if like is None or "color" not in like else 255.0 * np.array(like["color"])
    fruit = Fruit(
        id=spot.id,
        label=spot.label,
        center=spot.center,
        diameter=spot.diameter,
        diameter_sd=float("nan"),
        volume=float(np.pi / 6.0 * spot.diameter**3),
        axes=spot.axes,
        probability=1.0,
        visible_fraction=None,
        views=0,
        color=np.asarray(color).round().astype(np.uint8),
        kind="single",
        members=np.zeros(0, np.int64),
        fallen=None if like is None else like.get("fallen"),
        tree=None if like is None else like.get("tree"),
    )
    item = write_fruit(bpy_scene, fruit, frame, metres_per_unit=metres_per_unit(bpy_scene))
    judge(item, ADDED)
    bpy_scene[LAST_ID] = max(int(bpy_scene.get(LAST_ID, 0)), spot.id)
    return item


def choose_new_ids(bpy_scene: bpy.types.Scene, count: int) -> list[int]:
    """Choose ids that no fruit of this Blender scene ever had."""
    used = [int(item.get("id", 0)) for item in find_owned_objects(bpy_scene, "fruit")]
    last = max([int(bpy_scene.get(LAST_ID, 0)), *used])
    return list(range(last + 1, last + 1 + count))


def members(bpy_scene: bpy.types.Scene, item: bpy.types.Object) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices (M,) of the Gaussians of a fruit, and their positions (M, 3) in the scene frame.

    A copy that the user made of a fruit has the same id: each of them gets the Gaussians nearest to it.
    """
    found = read_gaussian_attributes(bpy_scene, "fruit_id", "position")
    if found is None:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    owners, places = found
    own = np.flatnonzero(owners == item["id"])
    same = [item]
    same += [each for each in find_owned_objects(bpy_scene, "fruit") if each.get("id") == item["id"] and each != item]
    if len(same) > 1:
        frame = scene_frame(bpy_scene)
        centers = np.array([fruit_ellipsoid(each, frame).center for each in same])
        nearest = np.linalg.norm(places[own, None] - centers, axis=2).argmin(axis=1)
        own = own[nearest == 0]
    return own, places[own].astype(np.float64)


def give_members(bpy_scene: bpy.types.Scene, own: NDArray[np.int64], numbers: NDArray[np.int64] | int) -> None:
    """Assign the Gaussians `own` (M,) to the fruit with these ids, (M,) or one."""
    item, found = find_owned_object(bpy_scene, "gaussians"), read_gaussian_attributes(bpy_scene, "fruit_id")
    if len(own) and item is not None and found is not None:
        found[0][own] = numbers
        set_attribute(item.data, "fruit_id", "INT", found[0])


def format_now() -> str:
    """Write the current time in the format of the log."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def write_log(bpy_scene: bpy.types.Scene, decision: Decision) -> None:
    """Add a decision to the log in the .blend."""
    entry = bpy_scene.fruitlangs.review.log.add()
    entry.action, entry.time, entry.reason = decision.action, decision.time, decision.reason
    for spots, kept in ((decision.before, entry.before), (decision.after, entry.after)):
        for spot in spots:
            keep_spot(kept, spot)


def keep_spot(rows: Any, spot: Spot) -> Any:
    """Add a spot to those in the .blend, and return its row."""
    row = rows.add()
    row.number, row.label = spot.id, spot.label
    row.center, row.axes = spot.center.tolist(), spot.axes.ravel().tolist()
    return row


def read_log(bpy_scene: bpy.types.Scene) -> list[Decision]:
    """The decisions in the .blend, oldest first."""
    from ...engine.counting.accounts.review import Decision

    return [
        Decision(entry.action, entry.time, entry.reason, tuple(spots_of(entry.before)), tuple(spots_of(entry.after)))
        for entry in bpy_scene.fruitlangs.review.log
    ]


def spots_of(rows: Any) -> list[Spot]:
    """The spots that `keep_spot` kept."""
    from ...engine.counting.accounts.review import Spot

    return [
        Spot(row.number, row.label, np.array(row.center, np.float64), np.array(row.axes, np.float64).reshape(3, 3))
        for row in rows
    ]
