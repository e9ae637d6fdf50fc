"""What a review keeps in the .blend: its log, and how the list of fruit is shown."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from bpy.props import (
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    FloatVectorProperty,
    IntProperty,
    StringProperty,
)

from ..operators.review.review import get_active_fruit, set_active_fruit


class FRUITLANGS_PG_spot(bpy.types.PropertyGroup):
    """One fruit as it stood, in the scene's frame."""

    number: IntProperty(name="Number")
    label: StringProperty(name="Label")
    center: FloatVectorProperty(name="Centre", size=3, precision=6)
    axes: FloatVectorProperty(name="Axes", size=9, precision=6)


class FRUITLANGS_PG_decision(bpy.types.PropertyGroup):
    """One entry of the log."""

    action: StringProperty(name="Action")
    time: StringProperty(name="Time", description="UTC")
    reason: StringProperty(name="Reason")
    before: CollectionProperty(type=FRUITLANGS_PG_spot)
    after: CollectionProperty(type=FRUITLANGS_PG_spot)


class FRUITLANGS_PG_aside(bpy.types.PropertyGroup):
    """The log of a source that is not shown now."""

    source: StringProperty(name="Source", description="Absolute")
    mark: StringProperty(name="Mark", description="A file of the source and its hash, by which it is known again")
    log: CollectionProperty(type=FRUITLANGS_PG_decision)


class FRUITLANGS_PG_review(bpy.types.PropertyGroup):
    """`scene.fruitlangs.review`."""

    log: CollectionProperty(type=FRUITLANGS_PG_decision)
    known: CollectionProperty(type=FRUITLANGS_PG_spot, description="The fruit that stood when last looked")
    aside: CollectionProperty(type=FRUITLANGS_PG_aside)
    reason: StringProperty(name="Reason", description="Why, for the log; taken by the next decision")
    label: StringProperty(name="Label", description="What Move to Label calls the selected fruit")
    dropped: IntProperty(
        name="From", default=1, min=1, description="The panel shows dropped clusters from this one on, largest first"
    )
    diameter: FloatProperty(
        name="New Diameter", min=0.0, precision=4, description="Of an added fruit, in scene units; 0: not given"
    )
    diameter_mm: FloatProperty(
        name="New Diameter in mm", min=0.0, precision=1, description="Of an added fruit, in millimetres; 0: not given"
    )
    parts: IntProperty(name="Into", default=2, min=2, max=12, description="How many fruit Split makes of one")
    show: EnumProperty(
        name="Show",
        items=[
            ("ALL", "All", "Every fruit"),
            ("OPEN", "Open", "Fruit that nobody has looked at yet"),
            ("DOUBTFUL", "Doubtful", "Open fruit less likely than the bound below"),
            ("REJECTED", "Rejected", "What was said to be no fruit"),
        ],
        description="Which fruit the list shows",
    )
    doubt: FloatProperty(
        name="Doubtful Below", default=0.8, min=0.0, max=1.0, precision=2, description="Probability below which"
    )
    sort: EnumProperty(
        name="Sort",
        items=[
            ("id", "Number", "By number"),
            ("probability", "Probability", "Least likely first"),
            ("diameter", "Diameter", "Smallest first"),
            ("visible_fraction", "Visible", "Most hidden first"),
            ("kind", "Kind", "By kind"),
            ("label", "Label", "By label"),
        ],
        description="The order of the list; the arrow below it turns the order round",
    )
    labels: EnumProperty(
        name="Labels",
        items=[
            ("NONE", "None", "Nothing is written in the viewport"),
            ("NUMBER", "Number", "The number of every fruit beside it"),
            ("NAME", "Name", "Label and number"),
            ("SIZE", "Size", "Number and diameter"),
        ],
        description="What is written beside every fruit in the viewport",
    )
    active_fruit: IntProperty(name="Fruit", get=get_active_fruit, set=set_active_fruit, options={"SKIP_SAVE"})


CLASSES = (FRUITLANGS_PG_spot, FRUITLANGS_PG_decision, FRUITLANGS_PG_aside, FRUITLANGS_PG_review)
