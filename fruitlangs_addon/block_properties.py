"""What a Blender scene stores of a block of trees: its folder and the list of its trees."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from bpy.props import CollectionProperty, EnumProperty, IntProperty, StringProperty

from ..operators.block.block import apply_block_colors, select_chosen_tree
from ..operators.settings.settings import RELATIVE


class FRUITLANGS_PG_block_tree(bpy.types.PropertyGroup):
    """A line of the list."""

    folder: StringProperty(name="Folder", description="Folder of its result in the block")
    problem: StringProperty(name="Problem", description="Why it has no count")
    note: StringProperty(name="Note", description="What to know about its count, such as that photos were added since")
    counted: IntProperty(name="Counted", default=-1, min=-1, description="Fruit before a review; -1 without a count")
    reviewed: IntProperty(name="Reviewed", default=-1, min=-1, description="Fruit after the review; -1 without one")


class FRUITLANGS_PG_block(bpy.types.PropertyGroup):
    """`scene.fruitlangs.block`."""

    folder: StringProperty(
        name="Folder", subtype="DIR_PATH", options=RELATIVE, description="Folder that count_orchard.py wrote (--out)"
    )
    trees: CollectionProperty(type=FRUITLANGS_PG_block_tree)
    active: IntProperty(name="Tree", update=select_chosen_tree, description="Active tree of the list")
    colors: EnumProperty(
        name="Colour",
        items=[
            ("TREE", "Tree", "A colour for each tree"),
            ("PROBABILITY", "Probability", "Yellow: certainly a fruit; blue: uncertain"),
        ],
        update=apply_block_colors,
        description="What the colours of the fruit show",
    )


CLASSES = (FRUITLANGS_PG_block_tree, FRUITLANGS_PG_block)
