"""Applies the user's decisions again after a count, and summarises the state of the review."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np

from ...engine.errors import FruitLangsError, VocabularyError
from ..blender_data import find_owned_object, find_owned_objects, remove_objects
from ..scene_frame import scene_frame
from .fruit_objects import (
    LAST_ID,
    REJECTED,
    REVIEW,
    count_edited,
    fruit_frame,
    give_members,
    is_made,
    judge,
    keep_sizes,
    list_counted_fruit,
    make_fruit,
    members,
    read_log,
    spot_of,
)
from .manual_edits import log_copies, log_deletions, remember_fruit
from .missing_fruit import count_many_missing, describe_missing, describe_rejected
from .write_fruits import label_fruit

if TYPE_CHECKING:
    from ...engine.counting.accounts.review import Decision, Reviewed
    from ...engine.counting.fruit import FruitCount


def keep_corrections(bpy_scene: bpy.types.Scene) -> list[str]:
    """Log which fruit the user deleted and copied, returned as texts, and where the user's own fruit are now, since
    they may have been moved and scaled.

    Raises:
        CountingError: many fruit are missing, or the mesh of one was edited.
        SceneError: the places and sizes of fruit are unknown.
    """
    if find_owned_object(bpy_scene, "root") is None:
        return []
    notices, frame = log_copies(bpy_scene), fruit_frame(bpy_scene)
    keep_sizes(bpy_scene, frame)
    made = [item for item in find_owned_objects(bpy_scene, "fruit") if is_made(item)]
    spots = {spot.id: spot for spot in (spot_of(item, frame) for item in reversed(made))}
    for row in _iterate_rows(bpy_scene):
        spot = spots.get(row.number)
        if spot is not None:
            row.center, row.axes = spot.center.tolist(), spot.axes.ravel().tolist()
    return notices + log_deletions(bpy_scene)


def keep_last_corrections(bpy_scene: bpy.types.Scene) -> list[str]:
    """As `keep_corrections`, before the fruit are replaced. Texts also say what cannot be read and is not kept, and how
    many counted fruit lose a position or size that the user gave them."""
    missing = describe_missing(bpy_scene)
    try:
        return [*keep_corrections(bpy_scene), *_describe_reset(bpy_scene)]
    except FruitLangsError as error:
        return [f"{missing} and are not rejected" if missing else f"changes by hand are not kept: {error}"]


def _describe_reset(bpy_scene: bpy.types.Scene) -> list[str]:
    edited = 0 if find_owned_object(bpy_scene, "root") is None else count_edited(bpy_scene, scene_frame(bpy_scene))
    text = f"{edited} fruit that you moved or scaled are as counted again; added fruit keep such changes"
    return [text] if edited else []


def _iterate_rows(bpy_scene: bpy.types.Scene) -> Iterator[Any]:
    """Yield every fruit in the log."""
    for entry in bpy_scene.fruitlangs.review.log:
        yield from entry.before
        yield from entry.after


def keep_decisions(bpy_scene: bpy.types.Scene, fruit_count: FruitCount, prompts: Sequence[str]) -> list[str]:
    """Apply the log to the fruit objects of a new count of these prompts; returns what could not be applied, as
    texts."""
    from ...engine.counting.accounts.review import replay, split_by_label

    bpy_scene[LAST_ID] = max(int(bpy_scene.get(LAST_ID, 0)), fruit_count.last_id)
    if find_owned_object(bpy_scene, "root") is None:
        return []
    frame = scene_frame(bpy_scene)
    log, others = split_by_label(read_log(bpy_scene), _labels(fruit_count, prompts))
    items = find_owned_objects(bpy_scene, "fruit")
    found = replay(log, [spot_of(item, frame) for item in items], bpy_scene[LAST_ID])
    kept = {source for source in found.sources if source >= 0}
    for spot, verdict, source in zip(found.spots, found.standings, found.sources, strict=True):
        if source < 0:
            judge(make_fruit(bpy_scene, spot, None), verdict)
            continue
        judge(items[source], verdict)
        if items[source]["label"] != spot.label:
            label_fruit(items[source], spot.label, bpy_scene)
    gone = {index: item for index, item in enumerate(items) if index not in kept}
    _give_members(bpy_scene, gone, found)
    remove_objects(gone.values())
    for row in _iterate_rows(bpy_scene):
        row.number = found.renumbered.get(row.number, row.number)
    bpy_scene.fruitlangs.review.known.clear()  # an id may belong to another fruit now
    remember_fruit(bpy_scene)
    return [*filter(None, [_warn_many_rejected(bpy_scene)]), *found.refused, *_list_not_applied(found.lost, others)]


def _warn_many_rejected(bpy_scene: bpy.types.Scene) -> str:
    text = describe_rejected(bpy_scene)
    return f"{text}. Restore Fruit in step 5 counts them again" if text else ""


def _labels(fruit_count: FruitCount, prompts: Sequence[str]) -> set[str]:
    """The labels that the fruit of a count may have."""
    from ...engine.language.vocabulary import parse

    labels = {fruit.label for fruit in fruit_count.fruits} | set(prompts)
    for prompt in prompts:
        with suppress(VocabularyError):
            labels.add(parse(prompt).text)
    return labels


def _give_members(bpy_scene: bpy.types.Scene, gone: dict[int, bpy.types.Object], found: Reviewed) -> None:
    """Assign the Gaussians of counted fruit that the user replaced, {index: object}, to the nearest of the new
    fruit."""
    for index, item in gone.items():
        heirs = [spot for spot, origins in zip(found.spots, found.origins, strict=True) if index in origins]
        own, places = members(bpy_scene, item)
        if heirs and len(own):
            away = [np.linalg.norm(places - spot.center, axis=1) / spot.diameter for spot in heirs]
            give_members(bpy_scene, own, np.array([spot.id for spot in heirs])[np.argmin(away, axis=0)])


def _list_not_applied(lost: Sequence[Decision], others: Sequence[Decision]) -> list[str]:
    notices = [
        f"{decision.action} of {', '.join(str(spot.id) for spot in decision.before)}: no longer found"
        for decision in lost
    ]
    if others:
        labels = sorted({spot.label for decision in others for spot in decision.before or decision.after})
        notices.append(f"{describe_kept(len(others), ', '.join(labels))} for the next count of them")
    return notices


def describe_kept(decisions: int, about: str) -> str:
    """Say '2 decisions on apple are kept'."""
    return f"1 decision on {about} is kept" if decisions == 1 else f"{decisions} decisions on {about} are kept"


def is_reviewed(bpy_scene: bpy.types.Scene) -> bool:
    """Whether the user has made any decision about the fruit of the last count."""
    counted = bpy_scene.fruitlangs.result.count
    return any(REVIEW in item for item in find_owned_objects(bpy_scene, "fruit")) or (
        counted >= 0 and len(list_counted_fruit(bpy_scene)) != counted
    )


def correct_interval_by_review(bpy_scene: bpy.types.Scene) -> tuple[int, int] | None:
    """Return the 90 % interval of the visible fruit, narrowed by the review; None if the count has none."""
    from ...engine.counting.accounts.review import correct_interval

    shown = bpy_scene.fruitlangs.result
    if shown.high < 0:
        return None
    own = [item for item in find_owned_objects(bpy_scene, "fruit") if not is_made(item)]
    probabilities = np.array([float(item.get("probability", 1.0)) for item in own])
    reviewed = np.array([REVIEW in item for item in own], bool)
    rejected = sum(item.get(REVIEW) == REJECTED for item in own)
    after = len(list_counted_fruit(bpy_scene))
    return correct_interval(shown.count, (shown.low, shown.high), probabilities, reviewed, rejected, after)


def review_line(bpy_scene: bpy.types.Scene) -> str:
    """'counted 182, after review 185, 90 % interval 178–196'; without the middle part before any review."""
    interval = None if count_many_missing(bpy_scene) else correct_interval_by_review(bpy_scene)
    return counts_line(bpy_scene) + ("" if interval is None else f", 90 % interval {interval[0]}–{interval[1]}")


def counts_line(bpy_scene: bpy.types.Scene) -> str:
    """'counted 182, after review 185'; without the second part before any review."""
    shown = bpy_scene.fruitlangs.result
    parts = [f"counted {shown.count}"] if shown.count >= 0 else []
    missing = describe_missing(bpy_scene)
    if missing:
        parts.append(missing)
    elif is_reviewed(bpy_scene):
        parts.append(f"after review {len(list_counted_fruit(bpy_scene))}")
    elif not parts:  # a .blend that the command line wrote
        parts.append(f"{len(list_counted_fruit(bpy_scene))} fruit")
    return ", ".join(parts)


def entry_text(entry: bpy.types.PropertyGroup) -> str:
    """One decision of the log: '2026-05-01 10:00 merge 12, 15 → 121 (one apple)'."""
    numbers = [", ".join(str(spot.number) for spot in spots) for spots in (entry.before, entry.after)]
    if entry.action == "relabel":
        numbers[1] = entry.after[0].label
    text = " → ".join(number for number in numbers if number)
    reason = f" ({entry.reason})" if entry.reason else ""
    return f"{entry.time[:16].replace('T', ' ')} {entry.action} {text}{reason}"
