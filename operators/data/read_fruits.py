"""Fruit objects as an engine count, with the user's corrections."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.errors import CountingError
from ..blender_data import find_owned_object, read_gaussian_attributes
from ..scene_frame import SceneFrame
from .fruit_objects import LAST_ID, SAME, choose_new_ids, fruit_frame, list_counted_fruit, metres_per_unit, spot_of
from .stored_audit import read_audit
from .stored_review import correct_interval_by_review, is_reviewed

if TYPE_CHECKING:
    from ...engine.counting.fruit import Fruit, FruitCount, Tree


def read_fruits(bpy_scene: bpy.types.Scene) -> FruitCount:
    """The current fruit of this Blender scene, by id, at their current positions and sizes.

    Rejected fruit are left out. A copy that the user made of a fruit has the same id; it gets a free one here. The
    interval is the corrected one. The number with hidden fruit is given only before any review. The audit is that of
    the count, before the review. The sampled points are not in a .blend; the position of a tree is the middle of its
    fruit, and trees without fruit are unknown.

    Raises:
        CountingError: nothing was counted, or the mesh of a fruit was edited.
        SceneError: the root was deleted, or the places and sizes of fruit are unknown.
    """
    from ...engine.counting.fruit import FruitCount

    if not has_count(bpy_scene):
        raise CountingError("Nothing is counted yet. Count first")
    frame = fruit_frame(bpy_scene)
    items = sorted(list_counted_fruit(bpy_scene), key=lambda item: (int(item.get("id", 0)), item.name))
    owners = _gaussian_attribute(bpy_scene, "fruit_id", np.int32)
    numbers = _assign_ids(bpy_scene, items)
    unit = metres_per_unit(bpy_scene) or 1.0
    fruits = [read_fruit(item, frame, number, owners, unit) for item, number in zip(items, numbers, strict=True)]
    shown = bpy_scene.fruitlangs.result
    has_total = shown.total >= 0.0 and not is_reviewed(bpy_scene) and len(fruits) == shown.count
    return FruitCount(
        fruits=fruits,
        audit=read_audit(bpy_scene),
        max_probability=float(_gaussian_attribute(bpy_scene, "probability", np.float32).max(initial=0.0)),
        mean_diameter=float(np.mean([fruit.diameter for fruit in fruits])) if fruits else None,
        last_id=max([int(bpy_scene.get(LAST_ID, 0)), *numbers]),
        interval=correct_interval_by_review(bpy_scene),
        total=float(shown.total) if has_total else None,
        total_interval=(shown.total_low, shown.total_high) if has_total else None,
        trees=_list_trees(fruits),
    )


def has_count(bpy_scene: bpy.types.Scene) -> bool:
    """Whether there was a count, including one of 0 fruit."""
    return bpy_scene.fruitlangs.result.count >= 0 or find_owned_object(bpy_scene, "fruit") is not None


def read_fruit(
    item: bpy.types.Object, frame: SceneFrame, number: int, owners: NDArray[np.int32], metres_per_unit: float
) -> Fruit:
    """One fruit object. owners: (N,) the fruit id of each Gaussian."""
    from ...engine.counting.fruit import Fruit

    spot = spot_of(item, frame)
    known = float(item.get("diameter", 0.0)) / metres_per_unit
    as_given = abs(spot.diameter - known) <= SAME * known
    fraction, fallen, tree = (item.get(key) for key in ("visible_fraction", "fallen", "tree"))
    return Fruit(
        id=number,
        label=spot.label,
        center=spot.center,
        diameter=spot.diameter,
        # Measured values do not apply to a size that the user set.
        diameter_sd=float(item.get("diameter_sd", np.nan)) / metres_per_unit if as_given else float("nan"),
        volume=float(np.pi / 6.0 * spot.diameter**3),
        axes=spot.axes,
        probability=float(item.get("probability", 1.0)),
        visible_fraction=None if fraction is None else float(fraction),
        views=int(item.get("views", 0)),
        color=np.round(255.0 * np.array(item.get("color", (0.8, 0.2, 0.2)), np.float64)).clip(0, 255).astype(np.uint8),
        kind=item.get("kind", "single"),
        members=np.flatnonzero(owners == number),
        fallen=None if fallen is None else bool(fallen),
        tree=None if tree is None else int(tree),
    )


def _assign_ids(bpy_scene: bpy.types.Scene, items: list[bpy.types.Object]) -> list[int]:
    """Return one id per fruit; the first of several with the same keeps it."""
    found = np.array([item.get("id", 0) for item in items], np.int64)
    first = np.zeros(len(found), bool)
    first[np.unique(found, return_index=True)[1]] = True
    found[~first] = choose_new_ids(bpy_scene, int((~first).sum()))
    return found.tolist()


def _list_trees(fruits: list[Fruit]) -> list[Tree]:
    from ...engine.counting.fruit import Tree

    trees = []
    for number in sorted({fruit.tree for fruit in fruits if fruit.tree is not None}):
        own = [fruit.center for fruit in fruits if fruit.tree == number]
        trees.append(Tree(number, np.mean(own, axis=0), len(own)))
    return trees


def _gaussian_attribute(bpy_scene: bpy.types.Scene, name: str, kind: type) -> NDArray[Any]:
    """(N,) an attribute of the Gaussians; empty if it is missing."""
    found = read_gaussian_attributes(bpy_scene, name)
    return np.zeros(0, kind) if found is None else found[0]
