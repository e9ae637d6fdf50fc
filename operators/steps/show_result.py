"""Shows engine values: in the viewport, and as text that the panel stores in the .blend."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.report.words import format_three_digits
from ..blender_data import find_owned_object, find_owned_objects, read_gaussian_attributes, set_attribute, to_array
from ..data.fruit_objects import metres_per_unit
from ..data.read_fruits import has_count
from ..data.read_gaussians import edits_of, find_unmoved, gaussian_indices
from ..data.stored_review import keep_decisions, keep_last_corrections
from ..data.write import SET_ID, write_result
from ..data.write_cameras import write_cameras
from ..data.write_gaussians import join_asked_words, write_gaussians
from ..data.write_points import hide_points, write_points
from ..data.write_root import write_root
from ..settings.panel_state import count_state, gaussians_state, scene_state, show_state
from ..settings.settings import format_stored_path, source_folder
from ..viewport.appearance import appearance_of, apply_appearance
from ..viewport.viewport import find_screens, look_at_scene, show_colors
from .ask import ask_soon, show_answer_text
from .shown_source import enter_source, forget_count

if TYPE_CHECKING:
    from ...engine.counting.fruit import FruitCount
    from ...engine.publishing import Result
    from ...engine.reconstruction import Reconstruction
    from ...engine.scene.camera import Scene
    from ...engine.training import RunLog


def show_scene(
    context: bpy.types.Context, bpy_scene: bpy.types.Scene, scene: Scene, notices: Sequence[str] = ()
) -> list[str]:
    """Show the cameras and sparse points of a scene without a reconstruction; returns what was removed, as texts, and
    the `notices` of the import.

    If fruit are shown, their scale stays.
    """
    settings = bpy_scene.fruitlangs
    removed = enter_source(bpy_scene, source_folder(settings)) if settings.source else []
    if scene.metres_per_unit is None and find_owned_objects(bpy_scene, "fruit"):
        scene = dataclasses.replace(scene, metres_per_unit=metres_per_unit(bpy_scene))
    root = write_root(bpy_scene, scene)
    if len(scene.points):
        write_points(bpy_scene, scene, root)
    apply_appearance(bpy_scene)
    write_cameras(bpy_scene, scene, root)
    show_state(settings.result, scene_state(scene))
    notices = [*removed, *notices]
    if notices:  # otherwise the messages of an earlier import or of the shown count still apply
        settings.result.notices = "; ".join(notices)
    show_colors(find_screens(context, bpy_scene), splats=appearance_of(bpy_scene).style == "SPLATS")
    look_at_scene(find_screens(context, bpy_scene), bpy_scene)
    return notices


def show_reconstruction(
    context: bpy.types.Context, bpy_scene: bpy.types.Scene, made: Reconstruction, log: RunLog
) -> list[str]:
    """Show Gaussians and cameras of a reconstruction; the panel's prompt is answered next. Returns what was removed, as
    texts.

    A count of the same Gaussians at the same scale stays; another one is removed, and its decisions apply to the next
    count.
    """
    notices = _enter(bpy_scene, made.origin)
    owners = _find_owners(bpy_scene, made)
    if owners is None and has_count(bpy_scene):
        notices += forget_count(bpy_scene)
        notices.append("the earlier count was removed, because the Gaussians or their scale changed. Count again")
    first = find_owned_object(bpy_scene, "root") is None
    first_gaussians = find_owned_object(bpy_scene, "gaussians") is None
    edits = edits_of(bpy_scene, to_array(made.gaussians.means))
    if edits:
        notices.append(f"Edited Gaussians are as reconstructed again: {edits.text}")
    root = write_root(bpy_scene, made.scene)
    item = write_gaussians(bpy_scene, made.scene, made.gaussians, None, (), root)
    if owners is not None:
        set_attribute(item.data, "fruit_id", "INT", owners)
    if first_gaussians:
        hide_points(bpy_scene)
    apply_appearance(bpy_scene)
    write_cameras(bpy_scene, made.scene, root)
    shown = bpy_scene.fruitlangs.result
    show_state(shown, scene_state(made.scene))
    features = format_stored_path(made.files.features)
    show_state(shown, gaussians_state(len(made.gaussians), made.origin["training"], features))
    shown.notices = "; ".join([*log.notices, *notices])
    show_colors(find_screens(context, bpy_scene), splats=appearance_of(bpy_scene).style == "SPLATS")
    if first:
        look_at_scene(find_screens(context, bpy_scene), bpy_scene)
    if not bpy.app.background:
        ask_soon(bpy_scene)
    return notices


def show_result(context: bpy.types.Context, bpy_scene: bpy.types.Scene, result: Result) -> None:
    """Show everything about a count."""
    notices = [*_enter(bpy_scene, result.origin), *keep_last_corrections(bpy_scene)]
    first = find_owned_object(bpy_scene, "root") is None
    first_gaussians = find_owned_object(bpy_scene, "gaussians") is None
    edits = edits_of(bpy_scene, to_array(result.gaussians.means))
    if edits:
        notices.append(
            f"Edited Gaussians were counted as reconstructed: {edits.text}. To leave out a part, add a region in step 1"
        )
    asked = join_asked_words(result.origin["prompts"], result.origin.get("negatives", ()))
    write_result(bpy_scene, result.scene, result.gaussians, result.probability, result.fruit_count, asked)
    if first_gaussians:
        hide_points(bpy_scene)
    apply_appearance(bpy_scene)
    bpy_scene[SET_ID] = result.set_id
    keep_result(bpy_scene.fruitlangs, result)
    notices += keep_decisions(bpy_scene, result.fruit_count, result.origin["prompts"])
    shown = bpy_scene.fruitlangs.result
    shown.notices = "; ".join([*filter(None, [shown.notices]), *notices])
    show_answer_text(bpy_scene)
    show_colors(find_screens(context, bpy_scene), splats=appearance_of(bpy_scene).style == "SPLATS")
    if first:
        look_at_scene(find_screens(context, bpy_scene), bpy_scene)


def _find_owners(bpy_scene: bpy.types.Scene, made: Reconstruction) -> NDArray[Any] | None:
    """Find the fruit (N,) of each Gaussian, -1 for those that the user deleted; None if the Gaussians or their scale
    have changed."""
    item, found = find_owned_object(bpy_scene, "gaussians"), read_gaussian_attributes(bpy_scene, "fruit_id")
    if item is None or found is None or find_unmoved(bpy_scene, to_array(made.gaussians.means)) is None:
        return None
    owners = np.full(len(made.gaussians), -1, np.int32)
    owners[gaussian_indices(item.data)] = found[0]
    return owners if np.isclose(metres_per_unit(bpy_scene) or 0.0, made.scene.metres_per_unit or 0.0) else None


def _enter(bpy_scene: bpy.types.Scene, origin: Mapping[str, Any]) -> list[str]:
    """Mark the Blender scene as showing the source of a result."""
    return enter_source(bpy_scene, Path(origin["source"])) if "source" in origin else []


def keep_result(settings: Any, result: Result) -> None:
    """Store in the .blend what the panel shows about a count."""
    shown = settings.result
    features = format_stored_path(result.out / "features.safetensors")
    show_state(shown, scene_state(result.scene))
    show_state(shown, gaussians_state(len(result.gaussians), result.origin["training"], features))
    show_state(shown, count_state(result, settings.prompt, format_stored_path(result.out)))
    shown.exported = ""


def report_line(shown: Any) -> str:
    """'apple: 7, mean diameter 81.2 mm'."""
    if shown.count:
        return f"{shown.label}: {shown.count}, {size_text(shown)}"
    return f"{shown.label}: 0, {shown.zero_reason}"


def make_count_report(shown: Any, fruit_count: FruitCount) -> tuple[set[str], str]:
    """Return the type of the report about a count and its text: a warning if fruit may have been taken for other
    kinds."""
    text, others = report_line(shown), fruit_count.other_fruit
    if not others:
        return {"INFO"}, text
    return {"WARNING"}, f"{text}; {others} other fruit look like other kinds" if shown.count else text


def size_text(shown: Any) -> str:
    """'mean diameter 81.2 mm'."""
    return f"mean diameter {format_three_digits(shown.mean_diameter)} {shown.unit}"
