"""The state of each of the six steps, and a sentence about what it needs next; fast, because every redraw computes
it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import PurePath
from typing import Literal

import bpy

from ...operators.blender_data import find_owned_object, find_owned_objects
from ...operators.data.fruit_objects import REVIEW, list_counted_fruit
from ...operators.data.missing_fruit import describe_missing
from ...operators.data.read_fruits import has_count
from ...operators.export.export_file import TITLE
from ...operators.steps.count import FRUITLANGS_OT_count
from ...operators.steps.import_scene import FRUITLANGS_OT_import_scene
from ...operators.steps.reconstruct import FRUITLANGS_OT_reconstruct

Name = Literal["scene", "reconstruct", "ask", "count", "review", "export"]
State = Literal["done", "next", "ready", "later", "wrong"]
ICONS: dict[State, str] = {
    "done": "CHECKMARK",
    "next": "PLAY",
    "ready": "RADIOBUT_ON",
    "later": "RADIOBUT_OFF",
    "wrong": "ERROR",
}
CHOOSE = "Choose a scene in step 1 first"


@dataclass(frozen=True)
class Step:
    """state: of the step; sentence: what it needs next, or how it ended; empty if the panel shows that anyway."""

    state: State
    sentence: str


@dataclass(frozen=True)
class Check:
    """The state of a step in a Blender scene: whether it is done, and whether everything it needs is there."""

    done: bool
    ready: bool
    sentence: str = ""


def step_of(name: Name, bpy_scene: bpy.types.Scene) -> Step:
    """The state of a step. `next` is the first one that is not done; `ready` ones can be done as well."""
    if _has_failed(name, bpy_scene):
        return Step("wrong", "")
    found = CHECKS[name](bpy_scene)
    if found.done:
        return Step("done", found.sentence)
    before = list(CHECKS)[: list(CHECKS).index(name)]
    if all(CHECKS[each](bpy_scene).done for each in before):
        return Step("next", found.sentence)
    return Step("ready" if found.ready else "later", found.sentence)


def _has_failed(name: Name, bpy_scene: bpy.types.Scene) -> bool:
    settings = bpy_scene.fruitlangs
    if name == "ask":
        return bool(settings.answer.problem)
    return bool(settings.failed) and settings.failed == TITLES.get(name)


def _check_scene(bpy_scene: bpy.types.Scene) -> Check:
    if bpy_scene.fruitlangs.result.cameras:
        return Check(True, True)
    chosen = bool(bpy_scene.fruitlangs.source)
    choose = "Choose a folder of photos, a .ply or the folder of an earlier result"
    return Check(False, True, "Press Import Scene to show it" if chosen else choose)


def _check_reconstruct(bpy_scene: bpy.types.Scene) -> Check:
    if find_owned_object(bpy_scene, "gaussians") is not None:
        return Check(True, True)
    settings = bpy_scene.fruitlangs
    if not settings.source:
        return Check(False, False, CHOOSE)
    return Check(False, True, f"Press Reconstruct to {'import' if settings.gaussians else 'train'} Gaussians")


def _check_ask(bpy_scene: bpy.types.Scene) -> Check:
    if bpy_scene.fruitlangs.answer.text:
        return Check(True, True)
    if find_owned_object(bpy_scene, "gaussians") is None:
        return Check(False, False, "Reconstruct in step 2 first")
    return Check(False, True, "Enter what to count")


def _check_count(bpy_scene: bpy.types.Scene) -> Check:
    settings = bpy_scene.fruitlangs
    if settings.result.count >= 0:
        return Check(True, True)
    if not settings.source:
        return Check(False, False, CHOOSE)
    if not settings.prompt.strip(" ,"):
        return Check(False, False, "Enter a prompt in step 3 first")
    if find_owned_object(bpy_scene, "gaussians") is None:
        return Check(False, True, "Count Fruit also runs the steps that are missing")
    return Check(False, True, "Press Count Fruit")


def _check_review(bpy_scene: bpy.types.Scene) -> Check:
    if not has_count(bpy_scene):
        return Check(False, False, "Count first, then review each fruit here")
    missing = describe_missing(bpy_scene)
    if missing:
        return Check(False, True, f"{missing}. Restore or reject them")
    fruit, bound = find_owned_objects(bpy_scene, "fruit"), bpy_scene.fruitlangs.review.doubt
    if not fruit:
        return Check(True, True, "No fruit to review. Use Add for fruit that were missed")
    uncertain = [item for item in fruit if item.get("probability", 1.0) < bound]
    left = sum(REVIEW not in item for item in uncertain)
    if left:
        return Check(
            False, True, f"{left} fruit below {bound:.2f} are not reviewed yet. Next Uncertain selects the first"
        )
    reviewed = f"All {len(uncertain)} uncertain fruit are reviewed"
    return Check(True, True, reviewed if uncertain else f"No uncertain fruit: none is below {bound:.2f}")


def _check_export(bpy_scene: bpy.types.Scene) -> Check:
    if not has_count(bpy_scene):
        return Check(False, False, "Count first, then export here")
    missing = describe_missing(bpy_scene)
    if missing:
        return Check(False, False, f"{missing}. Restore or reject them in step 5")
    written = bpy_scene.fruitlangs.result.exported
    stands = f"Writes the {len(list_counted_fruit(bpy_scene))} fruit of the reviewed count"
    if written:
        return Check(True, True, f"{stands}. Last file: {PurePath(written).name}")
    return Check(False, True, stands)


CHECKS: dict[Name, Callable[[bpy.types.Scene], Check]] = {
    "scene": _check_scene,
    "reconstruct": _check_reconstruct,
    "ask": _check_ask,
    "count": _check_count,
    "review": _check_review,
    "export": _check_export,
}
"""The steps in order."""
TITLES: dict[Name, str] = {
    "scene": FRUITLANGS_OT_import_scene.title,
    "reconstruct": FRUITLANGS_OT_reconstruct.title,
    "count": FRUITLANGS_OT_count.title,
    "export": TITLE,
}
"""The jobs of the steps."""
