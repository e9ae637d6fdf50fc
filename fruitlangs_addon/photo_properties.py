"""How photos are shown in the viewport, and what looking through one replaced."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from bpy.props import (
    BoolProperty,
    FloatProperty,
    FloatVectorProperty,
    IntVectorProperty,
    PointerProperty,
    StringProperty,
)

from ..operators.photos.photo_backgrounds import opacity_changed


class FRUITLANGS_PG_photos(bpy.types.PropertyGroup):
    """`scene.fruitlangs.photos`."""

    show: BoolProperty(
        name="Show Photo",
        default=True,
        update=opacity_changed,
        description="Show the photo when looking through its camera",
    )
    opacity: FloatProperty(
        name="Photo",
        default=0.7,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=opacity_changed,
        description="How strongly the photo covers what is reconstructed",
    )
    perspective: StringProperty(name="View", description="Of the free view; empty where no photo is looked through")
    location: FloatVectorProperty(name="Location", size=3, description="Of the free view")
    rotation: FloatVectorProperty(name="Rotation", size=4, description="Of the free view")
    distance: FloatProperty(name="Distance", description="Of the free view")
    camera: PointerProperty(type=bpy.types.Object, name="Camera", description="The scene's before photos")
    resolution: IntVectorProperty(name="Resolution", size=3, description="The scene's before photos")
    aspect: FloatVectorProperty(name="Aspect", size=2, description="The scene's pixel aspect before photos")
