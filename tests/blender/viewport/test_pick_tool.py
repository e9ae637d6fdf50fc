"""How a tool that waits for clicks begins and ends; the clicks themselves are driven in a window."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fruitlangs.operators.jobs import active_tool, jobs
from fruitlangs.operators.steps.show_result import show_result
from fruitlangs.operators.tools import pick_tool
from fruitlangs.operators.tools.pick_tool import PickTool
from fruitlangs.operators.viewport import viewport

PASSED = {"CANCELLED", "PASS_THROUGH"}
MOVE, ESC, CLICK = (
    SimpleNamespace(type=name, value="PRESS", mouse_x=0, mouse_y=0) for name in ("MOUSEMOVE", "ESC", "LEFTMOUSE")
)


class Tool(PickTool):
    bl_label, asks = "Pick", ("click on one", "click on another")

    allowed = True

    def __init__(self):
        self.reports, self.points = [], None

    @classmethod
    def poll(cls, context):
        return cls.allowed

    def report(self, level, text):
        self.reports.append(text)

    def handle_points(self, context, points):
        self.points = points
        return {"FINISHED"}


@pytest.fixture
def status(monkeypatch):
    """{workspace: what its status bar says}."""
    told = {}
    monkeypatch.setattr(
        bpy.types.WorkSpace, "status_text_set", lambda _, text: told.update({bpy.context.workspace.name: text})
    )
    return told


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn into viewports."""
    found = []

    def add(draw, *_):
        found.append(draw)
        return draw

    space = SimpleNamespace(draw_handler_add=add, draw_handler_remove=lambda draw, _: found.remove(draw))
    types = SimpleNamespace(SpaceView3D=space)
    monkeypatch.setattr(viewport, "bpy", SimpleNamespace(types=types, app=bpy.app, context=bpy.context))
    monkeypatch.setattr(viewport, "has_window", lambda: True)
    return found


@pytest.fixture
def context(monkeypatch, status, drawn):
    """A user at the 3D viewport of an empty file."""
    hit = SimpleNamespace(find_hit=lambda *_: np.zeros(3))
    monkeypatch.setattr(pick_tool, "Target3D", lambda bpy_scene: hit)
    area = next(area for area in bpy.context.screen.areas if area.type == "VIEW_3D")
    yield SimpleNamespace(
        area=area,
        screen=bpy.context.screen,
        scene=bpy.context.scene,
        mode="OBJECT",
        workspace=bpy.context.workspace,
        temp_override=bpy.context.temp_override,
        window_manager=SimpleNamespace(modal_handler_add=lambda tool: None),
    )
    active_tool.end_waiting()


def started(context) -> Tool:
    tool = Tool()
    assert tool.invoke(context, MOVE) == {"RUNNING_MODAL"}
    return tool


def has_ended(context, status, drawn) -> bool:
    return not drawn and not any(status.values())


def test_a_tool_waits_and_says_for_what_until_esc(context, status, drawn):
    tool = started(context)
    assert "click on one (1 of 2)" in status[context.workspace.name]
    assert tool.modal(context, MOVE) == {"PASS_THROUGH"}
    assert drawn
    assert tool.modal(context, ESC) == {"CANCELLED"}
    assert has_ended(context, status, drawn)


def test_a_viewport_that_became_another_editor_ends_the_tool(context, status, drawn):
    tool = started(context)
    context.area.type = "TEXT_EDITOR"
    assert tool.modal(context, MOVE) == PASSED
    assert has_ended(context, status, drawn)


def test_another_workspace_gets_its_clicks_and_ends_the_tool(context, status, drawn):
    tool = started(context)
    context.workspace = next(item for item in bpy.data.workspaces if item != context.workspace)
    context.screen = context.workspace.screens[0]
    assert tool.modal(context, MOVE) == PASSED
    assert has_ended(context, status, drawn)


def test_another_tool_ends_the_one_that_waits(context, status, drawn):
    first = started(context)
    second = started(context)
    assert first.modal(context, MOVE) == PASSED
    assert "click on one" in status[context.workspace.name]
    assert len(drawn) == 1
    second.cancel(context)
    assert has_ended(context, status, drawn)


@pytest.fixture
def clicks(context, monkeypatch):
    """The views that clicks looked along, and the region that they are in."""
    found = []
    region = SimpleNamespace(x=0, y=0, data="front")
    monkeypatch.setattr(pick_tool, "find_window_region", lambda area, event: region)
    hit = SimpleNamespace(find_hit=lambda region, view, place: found.append(view) or np.zeros(3))
    monkeypatch.setattr(pick_tool, "Target3D", lambda bpy_scene: hit)
    return SimpleNamespace(views=found, region=region)


def test_a_click_looks_along_the_view_of_its_own_region(context, clicks):
    tool = started(context)
    tool.modal(context, CLICK)
    clicks.region.data = "top"
    assert tool.modal(context, CLICK) == {"FINISHED"}
    assert clicks.views == ["front", "top"]
    assert tool.points.shape == (2, 3)


def test_another_scene_in_the_window_ends_the_tool_before_its_last_click(context, clicks, status, drawn):
    tool = started(context)
    tool.modal(context, CLICK)
    context.scene = bpy.data.scenes.new("Row 2")
    assert tool.modal(context, CLICK) == PASSED
    assert tool.points is None
    assert has_ended(context, status, drawn)


def test_what_may_not_be_done_any_more_is_not_done_with_the_last_click(context, clicks, monkeypatch):
    tool = started(context)
    tool.modal(context, CLICK)
    monkeypatch.setattr(Tool, "allowed", False)
    assert tool.modal(context, CLICK) == {"CANCELLED"}
    assert tool.points is None
    assert tool.reports == ["The clicked object was removed. Nothing was changed"]


def test_a_job_that_starts_ends_the_tool_that_waits(extension, context, status, drawn):
    tool = started(context)
    with pytest.raises(RuntimeError, match="No scene is chosen"):
        bpy.ops.fruitlangs.import_scene()
    assert has_ended(context, status, drawn)
    assert tool.modal(context, CLICK) == PASSED


@pytest.mark.parametrize("name", ["measure", "set_ground", "set_length", "add_fruit"])
def test_nothing_is_measured_or_added_while_a_job_would_take_it_away(
    extension, counted, result_of, tmp_path, monkeypatch, name
):
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    assert getattr(bpy.ops.fruitlangs, name).poll()
    monkeypatch.setattr(jobs, "find_running_job", lambda: "a job")
    assert not getattr(bpy.ops.fruitlangs, name).poll()


def test_disabling_the_extension_ends_the_tool_that_waits(extension, context, status, drawn):
    started(context)
    extension.unregister()
    assert has_ended(context, status, drawn)


def test_points_are_drawn_by_a_shader_for_points_where_blender_has_one(context, monkeypatch):
    used = {}

    def batch_for_shader(shader, kind, _):
        used[kind] = shader.name
        return SimpleNamespace(draw=lambda _: None)

    def from_builtin(name):
        return SimpleNamespace(name=name, bind=lambda: None, uniform_float=lambda *_: None)

    state = SimpleNamespace(depth_test_set=lambda _: None, point_size_set=lambda _: None)
    gpu = SimpleNamespace(shader=SimpleNamespace(from_builtin=from_builtin), state=state)
    monkeypatch.setitem(sys.modules, "gpu", gpu)
    monkeypatch.setitem(sys.modules, "gpu_extras.batch", SimpleNamespace(batch_for_shader=batch_for_shader))
    monkeypatch.setattr(Tool, "asks", ("one", "two", "three"))
    tool = started(context)
    tool._target3d.to_world = Matrix()
    tool._points = [np.zeros(3), np.ones(3)]
    tool._draw()
    points = "POINT_UNIFORM_COLOR" if bpy.app.version >= (4, 5, 0) else "UNIFORM_COLOR"
    assert used == {"POINTS": points, "LINE_STRIP": "UNIFORM_COLOR"}
