"""Settings of 3D viewports that make results visible."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Literal

import bpy
from mathutils import Matrix, Vector

from ..blender_data import areas_of, find_owned_objects
from ..root_placement import root_frame, upright_of
from ..scene_frame import find_world_matrix


class Drawing:
    """A function that is called whenever a 3D viewport is drawn, from `start` to `stop`; never in background mode.

    stage: POST_VIEW for drawing in the world, POST_PIXEL for the region's pixels.
    """

    def __init__(self, draw: Callable[[], None], stage: Literal["POST_VIEW", "POST_PIXEL"]) -> None:
        self._draw, self._stage = draw, stage
        self._handle: Any = None

    def start(self) -> None:
        if has_window() and self._handle is None:
            self._handle = bpy.types.SpaceView3D.draw_handler_add(self._draw, (), "WINDOW", self._stage)
            redraw_viewports()

    def stop(self) -> None:
        if self._handle is not None:
            bpy.types.SpaceView3D.draw_handler_remove(self._handle, "WINDOW")
            self._handle = None
            redraw_viewports()


def has_window() -> bool:
    """Whether there are viewports: False in background mode."""
    return not bpy.app.background


def find_screens(context: bpy.types.Context, bpy_scene: bpy.types.Scene) -> list[bpy.types.Screen]:
    """Return the screen that shows this Blender scene; empty in background mode, and while another scene is shown."""
    looked_at = has_window() and context.screen is not None and context.scene == bpy_scene
    return [context.screen] if looked_at else []


def show_colors(screens: Iterable[bpy.types.Screen], *, splats: bool) -> None:
    """Make viewports show Gaussians in colour: splats do in every shading mode, ellipsoids and points only in Material.

    Solid shows fruit in their object colour. The dashed lines from cameras and fruit to the root are switched off.
    """
    for space in _iterate_viewports(screens):
        if not splats and space.shading.type in {"SOLID", "WIREFRAME"}:
            space.shading.type = "MATERIAL"
        if space.shading.color_type == "MATERIAL":
            space.shading.color_type = "OBJECT"
        space.overlay.show_relationship_lines = False


def look_at_scene(screens: Iterable[bpy.types.Screen], bpy_scene: bpy.types.Scene) -> None:
    """Turn viewports to what the photos' cameras look at, from their distance."""
    frame = root_frame(bpy_scene)
    if frame is None:
        return
    upright = upright_of(frame)
    to_upright = upright @ frame.from_world()
    places = [to_upright @ find_world_matrix(item).translation for item in find_owned_objects(bpy_scene, "camera")]
    look_from_around(screens, places, frame.to_world @ upright.inverted())


def look_from_around(screens: Iterable[bpy.types.Screen], places: Sequence[Vector], placed: Matrix) -> None:
    """Turn viewports to what lies between these camera positions in the upright frame, from their distance.

    placed: (4, 4) from the upright frame to the world.
    """
    if not places:
        return
    middle = sum(places, Vector()) / len(places)
    distance = max(place.xy.length for place in places) * abs(placed.to_3x3().determinant()) ** (1.0 / 3.0)
    for space in _iterate_viewports(screens):
        view = space.region_3d
        if view.view_perspective == "CAMERA":
            view.view_perspective = "PERSP"
        view.view_location = placed @ Vector((0.0, 0.0, 0.8 * middle.z))
        view.view_distance = 1.3 * distance
        _widen_clipping(space, distance)


def look_at_point(screens: Iterable[bpy.types.Screen], place: Vector, distance: float) -> None:
    """Move viewports to a point in the world, no farther away than `distance`; they keep their direction."""
    for space in _iterate_viewports(screens):
        view = space.region_3d
        if view.view_perspective == "CAMERA":
            view.view_perspective = "PERSP"
        view.view_location = place
        view.view_distance = distance
        _widen_clipping(space, distance)


def _widen_clipping(space: Any, distance: float) -> None:
    """Show what is at this distance in a viewport, however small or large the user scaled the scene."""
    space.clip_start = min(space.clip_start, 0.05 * distance)
    space.clip_end = max(space.clip_end, 20.0 * distance)


def redraw_viewports() -> None:
    """Redraw every 3D viewport, sidebar included; for changes that no operator made."""
    for _, area in areas_of(bpy.context, "VIEW_3D"):
        area.tag_redraw()


def _iterate_viewports(screens: Iterable[bpy.types.Screen]) -> Iterator[Any]:
    for screen in screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                yield area.spaces.active
