"""The last check of the photos, as the panel shows it."""

# Blender declares properties by calls in annotations.
# mypy: disable-error-code="valid-type"

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, CollectionProperty, StringProperty

from ..operators.settings.settings import RELATIVE


class FRUITLANGS_PG_finding(bpy.types.PropertyGroup):
    """One finding of the check."""

    text: StringProperty(name="Finding", description="What was found and what to do")
    problem: BoolProperty(name="Problem", description="The run is likely to fail, or the count to be wrong")


class FRUITLANGS_PG_check(bpy.types.PropertyGroup):
    """The findings of the check, and the scene that was checked."""

    summary: StringProperty(name="Summary", description="Number of findings, and expected time and memory of a run")
    source: StringProperty(name="Source", subtype="DIR_PATH", options=RELATIVE, description="Scene that was checked")
    findings: CollectionProperty(type=FRUITLANGS_PG_finding)


CLASSES = (FRUITLANGS_PG_finding, FRUITLANGS_PG_check)
