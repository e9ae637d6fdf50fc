"""The properties of a Blender scene: source, prompt, the settings of every stage, and the last result."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty, IntProperty, PointerProperty, StringProperty

from ..operators.drawing.splat_drawing import edit_appearance_soon
from ..operators.settings.settings import RELATIVE, apply_preset, make_config_properties, stage_classes
from ..operators.steps.ask import answer_changed_words, apply_threshold, suggest_prompts
from ..operators.viewport.fruit_colours import apply_fruit_colors
from ..operators.viewport.gaussian_nodes import DIMMING
from . import block_properties as block
from . import check_properties as check
from . import review_properties as review
from . import teach_properties as teach
from .photo_properties import FRUITLANGS_PG_photos
from .review_properties import FRUITLANGS_PG_review


def _make_group(name: str, properties: dict[str, Any], doc: str | None) -> type:
    """Make a property group class created at run time, because its properties are computed."""
    return type(
        name, (bpy.types.PropertyGroup,), {"__annotations__": properties, "__doc__": doc, "__module__": __name__}
    )


UPDATES: dict[str, dict[str, Any]] = {"count": {"threshold": apply_threshold}}
"""{stage: {setting: update callback}}."""

STAGES = {
    stage: _make_group(
        f"FRUITLANGS_PG_{stage}", make_config_properties(config_class, UPDATES.get(stage, {})), config_class.__doc__
    )
    for stage, config_class in stage_classes().items()
}
"""{stage: property group}, one for each config of the engine."""

FRUITLANGS_PG_config = _make_group(
    "FRUITLANGS_PG_config",
    {stage: PointerProperty(type=group) for stage, group in STAGES.items()},
    "Every stage's settings.",
)


class FRUITLANGS_PG_result(bpy.types.PropertyGroup):
    """What the panel shows about the last import and the last count."""

    cameras: IntProperty(name="Cameras", min=0)
    points: IntProperty(name="Points", min=0)
    gaussians: IntProperty(name="Gaussians", min=0)
    quality: StringProperty(name="Quality", description="PSNR and SSIM of the held-out photos")
    features: StringProperty(
        name="Features", subtype="FILE_PATH", options=RELATIVE, description="File with the features of the Gaussians"
    )
    count: IntProperty(
        name="Count", default=-1, min=-1, description="Number of fruit counted; -1 before the first count"
    )
    low: IntProperty(name="Low", default=-1, min=-1, description="Lower end of the 90 % interval; -1 if there is none")
    high: IntProperty(
        name="High", default=-1, min=-1, description="Upper end of the 90 % interval; -1 if there is none"
    )
    total: FloatProperty(
        name="Total", default=-1.0, min=-1.0, description="Most likely number of all fruit; -1 if unknown"
    )
    total_low: IntProperty(
        name="Total Low", default=-1, min=-1, description="Lower end of the 90 % interval of all fruit"
    )
    total_high: IntProperty(
        name="Total High", default=-1, min=-1, description="Upper end of the 90 % interval of all fruit"
    )
    label: StringProperty(name="Label", description="What was counted")
    mean_diameter: FloatProperty(
        name="Mean Diameter", description="Mean diameter of the counted fruit, in the unit given next to it"
    )
    unit: StringProperty(name="Unit", description="Unit of lengths: mm if the scale is known, else scene units")
    zero_reason: StringProperty(name="Reason", description="Why the count is 0")
    sureness: StringProperty(name="Intervals", description="90 % intervals of the visible fruit and of all fruit")
    whereabouts: StringProperty(name="Locations", description="Number of fruit on the ground and on each tree of a row")
    notices: StringProperty(name="Notices", description="Notes on the last count")
    folder: StringProperty(name="Result Folder", subtype="DIR_PATH", options=RELATIVE)
    exported: StringProperty(
        name="Exported",
        subtype="FILE_PATH",
        options=RELATIVE,
        description="Last file exported from this count",
    )
    source: StringProperty(
        name="Source", subtype="DIR_PATH", options=RELATIVE, description="Source of the scene that is shown"
    )
    mark: StringProperty(name="Mark", description="A file of the source and its hash, which identify a moved source")
    work: StringProperty(
        name="Work",
        subtype="DIR_PATH",
        options=RELATIVE,
        description="Folder in which the next run on this source resumes",
    )


class FRUITLANGS_PG_answer(bpy.types.PropertyGroup):
    """Which Gaussians match the prompt."""

    text: StringProperty(name="Answer", description="How many Gaussians match the prompt")
    problem: StringProperty(name="Problem", description="Why the prompt cannot be matched")


class FRUITLANGS_PG_look(bpy.types.PropertyGroup):
    """Appearance of the Gaussians and the fruit."""

    style: EnumProperty(
        name="Show",
        items=[
            ("SPLATS", "Splats", "Draw splats as the photos show them, in every shading mode"),
            (
                "ELLIPSOIDS",
                "Ellipsoids",
                "Draw ellipsoids with Geometry Nodes; colours need Material Preview or Rendered",
            ),
            ("NONE", "Nothing", "Hide Gaussians in viewports; renders still show them"),
        ],
        default="SPLATS",
        update=edit_appearance_soon,
        description="How viewports show Gaussians; renders always show ellipsoids",
    )
    highlight: BoolProperty(
        name="Highlight",
        default=True,
        update=edit_appearance_soon,
        description="Highlight Gaussians that match the prompt, from grey at the threshold to yellow",
    )
    dimming: FloatProperty(
        name="Dimming",
        default=DIMMING,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=edit_appearance_soon,
        description="How much to darken Gaussians below the threshold",
    )
    fruit: EnumProperty(
        name="Fruit Colour",
        items=[
            ("LABEL", "Label", "A colour for each label"),
            ("TREE", "Tree", "A colour for each tree of a row"),
            ("PROBABILITY", "Probability", "Yellow: certainly a fruit; blue: uncertain"),
        ],
        update=apply_fruit_colors,
        description="What the colours of the fruit show",
    )


class FRUITLANGS_PG_settings(bpy.types.PropertyGroup):
    """`scene.fruitlangs`."""

    source: StringProperty(
        name="Scene",
        subtype="DIR_PATH",
        options=RELATIVE,
        description="Video, folder of photos with or without a COLMAP model, .ply of Gaussians, or earlier result",
    )
    out: StringProperty(
        name="Results",
        subtype="DIR_PATH",
        options=RELATIVE,
        description="Folder for results; if empty, the folder of the last run on this scene, else a folder next to the "
        ".blend or, before it is saved, next to the scene",
    )
    gaussians: StringProperty(
        name="Gaussians",
        subtype="FILE_PATH",
        options=RELATIVE,
        description="A .ply of Gaussians or coloured points in the frame of the scene's cameras; replaces training",
    )
    prompt: StringProperty(
        name="Prompt",
        default="apple",
        update=answer_changed_words,
        search=suggest_prompts,
        search_options={"SUGGESTION"},
        description="What to count, for example apple or red apple; separate several prompts by commas",
    )
    negative: StringProperty(
        name="Exclude",
        update=answer_changed_words,
        search=suggest_prompts,
        search_options={"SUGGESTION"},
        description="What to exclude, in addition to leaves, branches and other built-in negatives; separate by commas",
    )
    preset: EnumProperty(
        name="Preset",
        items=[
            ("quick", "Quick", "Preview in less than a minute"),
            ("standard", "Standard", "Full accuracy in a few minutes"),
            ("paper", "Paper", "The 30,000 steps of the paper"),
        ],
        default="standard",
        update=apply_preset,
        description="Training settings to start from; resets every setting of training",
    )
    error: StringProperty(name="Error", description="Error of the last job")
    failed: StringProperty(name="Failed", description="Name of the job that failed; empty if none")
    config: PointerProperty(type=FRUITLANGS_PG_config)
    answer: PointerProperty(type=FRUITLANGS_PG_answer)
    look: PointerProperty(type=FRUITLANGS_PG_look)
    review: PointerProperty(type=FRUITLANGS_PG_review)
    photos: PointerProperty(type=FRUITLANGS_PG_photos)
    result: PointerProperty(type=FRUITLANGS_PG_result)
    teach: PointerProperty(type=teach.FRUITLANGS_PG_teach)
    block: PointerProperty(type=block.FRUITLANGS_PG_block)
    check: PointerProperty(type=check.FRUITLANGS_PG_check)


CLASSES = (
    *STAGES.values(),
    FRUITLANGS_PG_config,
    FRUITLANGS_PG_answer,
    FRUITLANGS_PG_look,
    FRUITLANGS_PG_result,
    *review.CLASSES,
    *check.CLASSES,
    *teach.CLASSES,
    *block.CLASSES,
    FRUITLANGS_PG_photos,
    FRUITLANGS_PG_settings,
)
