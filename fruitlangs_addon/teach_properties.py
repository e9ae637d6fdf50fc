"""The word that is taught in a scene, and its examples."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, CollectionProperty, FloatVectorProperty, IntProperty, StringProperty

from ..operators.steps.teach import show_soon


class FRUITLANGS_PG_example(bpy.types.PropertyGroup):
    """One example."""

    place: FloatVectorProperty(name="Place", size=3, precision=6, description="Position in the scene frame")
    positive: BoolProperty(
        name="Positive", default=True, update=show_soon, description="Whether the example shows the word"
    )
    source: StringProperty(name="Source", description="A click, or the number of a reviewed fruit")


class FRUITLANGS_PG_teach(bpy.types.PropertyGroup):
    """`scene.fruitlangs.teach`."""

    word: StringProperty(
        name="Word",
        update=show_soon,
        description="Name of the fruit, without colour or ripeness, for example fig or cherry tomato",
    )
    examples: CollectionProperty(type=FRUITLANGS_PG_example)
    active: IntProperty(name="Example", default=-1, description="Selected example of the list")
    saved: StringProperty(name="Saved", description="Where the word was saved last")


CLASSES = (FRUITLANGS_PG_example, FRUITLANGS_PG_teach)
