"""The state that a Blender scene keeps: what to count where, the settings of every stage, and the last result."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..operators.drawing.splat_drawing import look_edited
from ..operators.settings.settings import RELATIVE, apply_preset, config_properties, stage_classes
from ..operators.steps.ask import suggestions, threshold_changed, words_changed
from ..operators.viewport.gaussian_nodes import DIMMING
from . import review_properties as review
from .photo_properties import FRUITLANGS_PG_photos
from .review_properties import FRUITLANGS_PG_review


def _group(name: str, properties: dict[str, Any], doc: str | None) -> type:
    """A property group class made by call, because its properties are computed."""
    return type(
        name, (bpy.types.PropertyGroup,), {"__annotations__": properties, "__doc__": doc, "__module__": __name__}
    )


UPDATES: dict[str, dict[str, Any]] = {"count": {"threshold": threshold_changed}}
"""{stage: {setting: what an edit of it calls}}."""

STAGES = {
    stage: _group(
        f"FRUITLANGS_PG_{stage}", config_properties(config_class, UPDATES.get(stage, {})), config_class.__doc__
    )
    for stage, config_class in stage_classes().items()
}
"""{stage: property group}, one for each config of the engine."""

FRUITLANGS_PG_config = _group(
    "FRUITLANGS_PG_config",
    {stage: PointerProperty(type=group) for stage, group in STAGES.items()},
    "Every stage's settings.",
)


class FRUITLANGS_PG_result(bpy.types.PropertyGroup):
    """What the panel shows of the last import and the last count."""

    cameras: IntProperty(name="Cameras", min=0)
    points: IntProperty(name="Points", min=0)
    gaussians: IntProperty(name="Gaussians", min=0)
    quality: StringProperty(name="Quality", description="How well photos kept aside from training are drawn")
    features: StringProperty(name="Features", subtype="FILE_PATH", options=RELATIVE, description="Of the Gaussians")
    count: IntProperty(name="Count", default=-1, min=-1, description="Fruit counted; -1 before there was a count")
    low: IntProperty(name="Low", default=-1, min=-1, description="Of the 90 % interval; -1 where none is told")
    high: IntProperty(name="High", default=-1, min=-1, description="Of the 90 % interval; -1 where none is told")
    total: FloatProperty(name="Total", default=-1.0, min=-1.0, description="Likeliest number of all; -1 where not told")
    total_low: IntProperty(name="Total Low", default=-1, min=-1, description="Of the 90 % interval of all")
    total_high: IntProperty(name="Total High", default=-1, min=-1, description="Of the 90 % interval of all")
    label: StringProperty(name="Label", description="What was counted")
    mean_diameter: FloatProperty(name="Mean Diameter", description="Of the counted fruit, in the unit beside it")
    unit: StringProperty(name="Unit", description="mm where the scene's scale is known, else scene units")
    zero_reason: StringProperty(name="Reason", description="Why nothing was counted")
    sureness: StringProperty(name="Sureness", description="90 % intervals of the visible fruit and of all")
    whereabouts: StringProperty(name="Whereabouts", description="Fruit on the ground, and fruit on each tree of a row")
    notices: StringProperty(name="Notices", description="What is to be known of a count that went well")
    folder: StringProperty(name="Result Folder", subtype="DIR_PATH", options=RELATIVE)
    exported: StringProperty(
        name="Exported",
        subtype="FILE_PATH",
        options=RELATIVE,
        description="The file of this count that was written last",
    )
    source: StringProperty(
        name="Source", subtype="DIR_PATH", options=RELATIVE, description="What is shown and measured was made from it"
    )
    mark: StringProperty(name="Mark", description="A file of the source and its hash, by which it is known again")
    work: StringProperty(
        name="Work", subtype="DIR_PATH", options=RELATIVE, description="Where the next run on this source goes on"
    )


class FRUITLANGS_PG_answer(bpy.types.PropertyGroup):
    """What the Gaussians answered to the prompt."""

    text: StringProperty(name="Answer")
    problem: StringProperty(name="Problem", description="Why there is no answer")


class FRUITLANGS_PG_look(bpy.types.PropertyGroup):
    """How Gaussians look."""

    style: EnumProperty(
        name="Show",
        items=[
            ("SPLATS", "Splats", "As the photos show them, in every shading mode"),
            ("ELLIPSOIDS", "Ellipsoids", "As Geometry Nodes render them; in colour in Material Preview and Rendered"),
            ("NONE", "Nothing", "Not in viewports; renders show them still"),
        ],
        default="SPLATS",
        update=look_edited,
        description="How viewports show Gaussians; renders always show ellipsoids",
    )
    highlight: BoolProperty(
        name="Highlight",
        default=True,
        update=look_edited,
        description="Light what answers to the prompt, grey at the threshold to yellow where it is certain, and dim "
        "the rest",
    )
    dimming: FloatProperty(
        name="Dimming",
        default=DIMMING,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=look_edited,
        description="How much of its brightness loses what stays below the threshold",
    )


class FRUITLANGS_PG_settings(bpy.types.PropertyGroup):
    """`scene.fruitlangs`."""

    source: StringProperty(
        name="Scene",
        subtype="DIR_PATH",
        options=RELATIVE,
        description="Folder of photos, with a COLMAP model or alone, or of an earlier result; or a .ply of Gaussians",
    )
    out: StringProperty(
        name="Results",
        subtype="DIR_PATH",
        options=RELATIVE,
        description="Folder for results; when empty, that of the last run on this scene, else one beside the .blend "
        "(or beside the scene, if never saved)",
    )
    gaussians: StringProperty(
        name="Gaussians",
        subtype="FILE_PATH",
        options=RELATIVE,
        description="A .ply of Gaussians or coloured points in the frame of the scene's cameras, instead of training",
    )
    prompt: StringProperty(
        name="Prompt",
        default="apple",
        update=words_changed,
        search=suggestions,
        search_options={"SUGGESTION"},
        description="What to count, as apple or red apple; several with commas",
    )
    negative: StringProperty(
        name="Not",
        update=words_changed,
        search=suggestions,
        search_options={"SUGGESTION"},
        description="What must not be counted, beside what is told apart by itself; several words with commas",
    )
    preset: EnumProperty(
        name="Preset",
        items=[
            ("quick", "Quick", "A first look, in a few times ten seconds"),
            ("standard", "Standard", "What counts well, in minutes"),
            ("paper", "Paper", "The paper's 30,000 steps"),
        ],
        default="standard",
        update=apply_preset,
        description="Sets every setting of training; change single ones after it",
    )
    error: StringProperty(name="Error", description="What went wrong last")
    failed: StringProperty(name="Failed", description="The work that went wrong, empty where none did")
    config: PointerProperty(type=FRUITLANGS_PG_config)
    answer: PointerProperty(type=FRUITLANGS_PG_answer)
    look: PointerProperty(type=FRUITLANGS_PG_look)
    review: PointerProperty(type=FRUITLANGS_PG_review)
    photos: PointerProperty(type=FRUITLANGS_PG_photos)
    result: PointerProperty(type=FRUITLANGS_PG_result)


CLASSES = (
    *STAGES.values(),
    FRUITLANGS_PG_config,
    FRUITLANGS_PG_answer,
    FRUITLANGS_PG_look,
    FRUITLANGS_PG_result,
    *review.CLASSES,
    FRUITLANGS_PG_photos,
    FRUITLANGS_PG_settings,
)
