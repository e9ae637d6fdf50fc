"""Settings of photos in the viewport, and the view that a photo replaced."""

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

from ..operators.photos.photo_backgrounds import apply_opacity


class FRUITLANGS_PG_photos(bpy.types.PropertyGroup):
    """`scene.fruitlangs.photos`."""

    show: BoolProperty(
        name="Show Photo",
        default=True,
        update=apply_opacity,
        description="Show the photo in the view through its camera",
    )
    opacity: FloatProperty(
        name="Photo",
        default=0.7,
        min=0.0,
        max=1.0,
        subtype="FACTOR",
        update=apply_opacity,
        description="Opacity of the photo over the reconstruction",
    )
    perspective: StringProperty(name="View", description="Mode of the free view; empty if no photo is shown")
    location: FloatVectorProperty(name="Location", size=3, description="Location of the free view")
    rotation: FloatVectorProperty(name="Rotation", size=4, description="Rotation of the free view")
    distance: FloatProperty(name="Distance", description="Distance of the free view")
    camera: PointerProperty(type=bpy.types.Object, name="Camera", description="Active camera before a photo was shown")
    resolution: IntVectorProperty(name="Resolution", size=3, description="Render resolution before a photo was shown")
    aspect: FloatVectorProperty(name="Aspect", size=2, description="Pixel aspect before a photo was shown")
