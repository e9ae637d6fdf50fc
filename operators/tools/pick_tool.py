"""Picks points on the tree by clicks: the common part of the tools that measure, level and add."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
import numpy as np
from bpy_extras import view3d_utils
from mathutils import Vector
from numpy.typing import NDArray

from ...engine.errors import FruitLangsError
from ...engine.language.teaching.ray_hits import pick_point, pick_surface
from ..blender_data import find_owned_object, get_attribute, point_positions
from ..jobs.active_tool import begin_waiting, end_waiting, is_waiting
from ..jobs.jobs import LEAVE_EDITING, is_busy, is_linked, show_status
from ..scene_frame import scene_frame
from ..viewport.viewport import Drawing, redraw_viewports

REACH_PIXELS = 12
"""Distance in pixels between a click and a sparse point that it picks."""
RETURNS = ("RET", "NUMPAD_ENTER")
ENDS = ("ESC", "RIGHTMOUSE", *RETURNS)
"""Events that end the tool; RETURNS only if it is endless."""
MARK_COLOR, MARK_SIZE = (1.0, 0.85, 0.1, 1.0), 9.0
MARK_SHADER = "POINT_UNIFORM_COLOR" if bpy.app.version >= (4, 5, 0) else "UNIFORM_COLOR"
"""Metal and Vulkan draw points with a special shader, which Blender has from 4.5 on."""


class Target3D:
    """The pickable data of a Blender scene, in the scene frame: the Gaussians, or the sparse points before there are
    any.

    Raises:
        SceneError: the scene frame is unknown, or the points were moved within their mesh.
    """

    def __init__(self, bpy_scene: bpy.types.Scene) -> None:
        item = find_owned_object(bpy_scene, "gaussians")
        self.surface = item is not None
        item = item or find_owned_object(bpy_scene, "points")
        assert item is not None
        frame = scene_frame(bpy_scene)
        self.to_world, self._from_world = frame.to_world, frame.from_world()
        names = ("scale", "quaternion", "opacity") if self.surface else ()
        self._means = point_positions(item)
        self._rest = [get_attribute(item.data, name) for name in names]

    def find_hit(self, region: Any, view: Any, place: Sequence[float]) -> NDArray[np.float64] | None:
        """Find the point (3,) under a click at `place`, pixels of the region; None if there is none."""
        back = self._from_world
        self.direction = np.zeros(3)
        start = view3d_utils.region_2d_to_origin_3d(region, view, place)
        along = view3d_utils.region_2d_to_vector_3d(region, view, place)
        origin = np.array(back @ start)
        direction = np.array(back.to_3x3() @ along)
        direction /= np.linalg.norm(direction)
        self.direction = direction
        if self.surface:
            return pick_surface(origin, direction, self._means, *self._rest)
        next_to = view3d_utils.region_2d_to_vector_3d(region, view, (place[0] + REACH_PIXELS, place[1]))
        slope = 0.0 if not view.is_perspective else float(along.angle(next_to))
        shift = view3d_utils.region_2d_to_origin_3d(region, view, (place[0] + REACH_PIXELS, place[1])) - start
        reach = float((back.to_3x3() @ shift).length)
        return pick_point(origin, direction, self._means, slope=slope, reach=reach)


class PickTool:
    """Mix-in of operators for which the user clicks on points.

    The view can be rotated and zoomed in the meantime. Backspace removes the last point; Esc or the right button ends
    it, and so does another tool, a job, another Blender scene in the window, or a change of the editor, workspace or
    area.
    """

    asks: Sequence[str] = ()
    """Instructions for the user, one text per point."""
    endless = False
    """Whether it goes on after the last instruction, until Return, Esc or the right button."""

    @classmethod
    def poll(cls: Any, context: bpy.types.Context) -> bool:
        if is_busy(cls) or is_linked(cls, context):
            return False
        if context.scene is None or find_owned_object(context.scene, "root") is None:
            cls.poll_message_set("There is nothing to click on yet: import a scene first")
            return False
        if not any(find_owned_object(context.scene, role) for role in ("gaussians", "points")):
            cls.poll_message_set("There is nothing to click on yet: press Reconstruct")
            return False
        return True

    def handle_points(self, context: bpy.types.Context, points: NDArray[np.float64]) -> set[str]:
        """Called when all points were clicked, (P, 3) in the scene frame."""
        raise NotImplementedError

    def handle_click(self, context: bpy.types.Context, point: NDArray[np.float64], event: bpy.types.Event) -> None:
        """Called after every click of an endless tool, with the point (3,) in the scene frame."""

    def take_back_click(self, context: bpy.types.Context) -> None:
        """Called after Backspace in an endless tool."""

    def invoke(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        if context.area is None or context.area.type != "VIEW_3D":
            self.report({"ERROR"}, "Start this from a 3D viewport")
            return {"CANCELLED"}
        if context.mode != "OBJECT":
            self.report({"ERROR"}, LEAVE_EDITING)
            return {"CANCELLED"}
        try:
            self._target3d = Target3D(context.scene)
        except FruitLangsError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        self._points: list[NDArray[np.float64]] = []
        self._area_pointer = context.area.as_pointer()
        self._scene = context.scene.session_uid
        self._marks = Drawing(self._draw, "POST_VIEW")
        begin_waiting(self)
        self._marks.start()
        self._ask(context)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self: Any, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        area = self._find_area(context)
        if area is None or context.scene is None or context.scene.session_uid != self._scene:
            self._leave()
        if not is_waiting(self):
            return {"CANCELLED", "PASS_THROUGH"}
        if event.type in ENDS and event.value == "PRESS" and (self.endless or event.type not in RETURNS):
            self._leave()
            return {"FINISHED" if self.endless and self._points else "CANCELLED"}
        if event.type == "BACK_SPACE" and event.value == "PRESS" and self._points:
            self._points.pop()
            if self.endless:
                self.take_back_click(context)
            self._ask(context)
            return {"RUNNING_MODAL"}
        window = find_window_region(area, event)
        if event.type != "LEFTMOUSE" or event.value != "PRESS" or window is None:
            return {"PASS_THROUGH"}
        place = (event.mouse_x - window.x, event.mouse_y - window.y)
        point = self._target3d.find_hit(window, window.data, place)
        if point is None:
            self.report({"WARNING"}, "Nothing under the mouse. Click on the tree or the ground")
            return {"RUNNING_MODAL"}
        self._points.append(point)
        if self.endless:
            self.handle_click(context, point, event)
        if self.endless or len(self._points) < len(self.asks):
            self._ask(context)
            return {"RUNNING_MODAL"}
        self._leave()
        if not self.poll(context):
            self.report({"WARNING"}, "The clicked object was removed. Nothing was changed")
            return {"CANCELLED"}
        return self.handle_points(context, np.array(self._points, np.float64))

    def cancel(self: Any, context: bpy.types.Context) -> None:
        """Called by Blender when the file or the window is closed."""
        self._leave()

    def _find_area(self: Any, context: bpy.types.Context) -> bpy.types.Area | None:
        """Find the viewport that it was started in; None if it was closed, hidden or changed to another editor."""
        found = (area for area in context.screen.areas if area.as_pointer() == self._area_pointer)
        return next((area for area in found if area.type == "VIEW_3D"), None)

    def _ask(self: Any, context: bpy.types.Context) -> None:
        number = len(self._points)
        if self.endless:
            text = f"{self.bl_label}: {self.asks[0]} ({number} so far). Backspace: undo, Return: finish"
        else:
            ask = f"{self.asks[number]} ({number + 1} of {len(self.asks)})"
            text = f"{self.bl_label}: {ask}. Backspace: undo, Esc: cancel"
        show_status(context, text)
        redraw_viewports()

    def _leave(self) -> None:
        """Stop waiting; nothing if another tool waits now."""
        if is_waiting(self):
            end_waiting()

    def stop_showing(self: Any) -> None:
        """Remove what it showed."""
        self._marks.stop()
        show_status(bpy.context, None)

    def _draw(self: Any) -> None:
        """Draw the points so far, in front of everything."""
        import gpu
        from gpu_extras.batch import batch_for_shader

        if not self._points:
            return
        places = [tuple(self._target3d.to_world @ Vector(point)) for point in self._points]
        marks, lines = (gpu.shader.from_builtin(name) for name in (MARK_SHADER, "UNIFORM_COLOR"))
        gpu.state.depth_test_set("NONE")
        gpu.state.point_size_set(MARK_SIZE)
        marks.bind()
        marks.uniform_float("color", MARK_COLOR)
        if MARK_SHADER != "UNIFORM_COLOR":
            marks.uniform_float("size", MARK_SIZE)
        batch_for_shader(marks, "POINTS", {"pos": places}).draw(marks)
        gpu.state.point_size_set(1.0)
        if len(places) > 1:
            lines.bind()
            lines.uniform_float("color", MARK_COLOR)
            batch_for_shader(lines, "LINE_STRIP", {"pos": places}).draw(lines)


def find_window_region(area: bpy.types.Area, event: bpy.types.Event) -> Any:
    """Find the region of a viewport under the mouse that shows the tree, which its sidebar may overlap."""
    inside = [
        region
        for region in area.regions
        if 0 <= event.mouse_x - region.x < region.width and 0 <= event.mouse_y - region.y < region.height
    ]
    if any(region.type != "WINDOW" for region in inside):
        return None
    return inside[0] if inside else None
