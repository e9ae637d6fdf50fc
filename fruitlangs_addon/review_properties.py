"""What a review stores in the .blend: its log, and the settings of the list of fruit."""

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
from ..operators.settings.settings import RELATIVE


class FRUITLANGS_PG_spot(bpy.types.PropertyGroup):
    """One fruit before or after a decision, in the scene frame."""

    number: IntProperty(name="Number", description="Number of the fruit")
    label: StringProperty(name="Label", description="Label of the fruit")
    center: FloatVectorProperty(name="Centre", size=3, precision=6, description="Position in the scene frame")
    axes: FloatVectorProperty(name="Axes", size=9, precision=6, description="Half axes in the scene frame")
    details: StringProperty(name="Details", description="Custom properties of the fruit (JSON); empty in the log")


class FRUITLANGS_PG_decision(bpy.types.PropertyGroup):
    """One entry of the log."""

    action: StringProperty(name="Action", description="What was decided")
    time: StringProperty(name="Time", description="Time of the decision (UTC)")
    reason: StringProperty(name="Reason", description="Why it was decided")
    before: CollectionProperty(type=FRUITLANGS_PG_spot)
    after: CollectionProperty(type=FRUITLANGS_PG_spot)


class FRUITLANGS_PG_aside(bpy.types.PropertyGroup):
    """The log of a source that is not shown now."""

    source: StringProperty(name="Source", subtype="DIR_PATH", options=RELATIVE, description="Path of the source")
    mark: StringProperty(name="Mark", description="A file of the source and its hash, which identify a moved source")
    log: CollectionProperty(type=FRUITLANGS_PG_decision)


class FRUITLANGS_PG_review(bpy.types.PropertyGroup):
    """`scene.fruitlangs.review`."""

    log: CollectionProperty(type=FRUITLANGS_PG_decision)
    known: CollectionProperty(type=FRUITLANGS_PG_spot, description="Fruit at the last check")
    aside: CollectionProperty(type=FRUITLANGS_PG_aside)
    reason: StringProperty(name="Reason", description="Reason for the next decision, kept in the log")
    label: StringProperty(name="Label", description="New label of the selected fruit")
    dropped: IntProperty(
        name="From", default=1, min=1, description="First dropped cluster that is shown, largest first"
    )
    diameter: FloatProperty(
        name="New Diameter", min=0.0, precision=4, description="Diameter of added fruit in scene units; 0 if unknown"
    )
    diameter_mm: FloatProperty(
        name="New Diameter", min=0.0, precision=1, description="Diameter of added fruit in millimetres; 0 if unknown"
    )
    parts: IntProperty(name="Parts", default=2, min=2, max=12, description="Number of fruit that Split makes")
    show: EnumProperty(
        name="Show",
        items=[
            ("ALL", "All", "Show every fruit"),
            ("OPEN", "Not Reviewed", "Fruit that are not reviewed yet"),
            ("DOUBTFUL", "Uncertain", "Fruit that are not reviewed yet, with a lower probability than the limit below"),
            ("REJECTED", "Rejected", "Fruit that were rejected"),
        ],
        description="Fruit that the list shows",
    )
    doubt: FloatProperty(
        name="Uncertain Below",
        default=0.8,
        min=0.0,
        max=1.0,
        precision=2,
        description="Probability below which fruit are uncertain",
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
        description="Order of the list; the arrow below the list reverses it",
    )
    labels: EnumProperty(
        name="Labels",
        items=[
            ("NONE", "None", "Show no text"),
            ("NUMBER", "Number", "Show the number of each fruit"),
            ("NAME", "Name", "Show label and number"),
            ("SIZE", "Size", "Show number and diameter"),
        ],
        description="Text next to each fruit in the viewport",
    )
    active_fruit: IntProperty(
        name="Fruit",
        get=get_active_fruit,
        set=set_active_fruit,
        options={"SKIP_SAVE"},
        description="Active fruit of the list",
    )


CLASSES = (FRUITLANGS_PG_spot, FRUITLANGS_PG_decision, FRUITLANGS_PG_aside, FRUITLANGS_PG_review)
