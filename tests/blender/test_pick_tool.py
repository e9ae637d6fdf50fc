"""How a tool that waits for clicks begins and ends; the clicks themselves are driven in a window."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fruitlangs.operators import pick_tool, viewport
from fruitlangs.operators.pick_tool import PickTool

PASSED = {"CANCELLED", "PASS_THROUGH"}
MOVE, ESC = (SimpleNamespace(type=name, value="PRESS", mouse_x=0, mouse_y=0) for name in ("MOUSEMOVE", "ESC"))


class Tool(PickTool):
    bl_label, asks = "Pick", ("click on one", "click on another")

    def report(self, level, text):
        raise AssertionError(text)

    def picked(self, context, points):
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
    monkeypatch.setattr(viewport, "in_window", lambda: True)
    return found


@pytest.fixture
def context(monkeypatch, status, drawn):
    """A person at the 3D viewport of an empty file."""
    hit = SimpleNamespace(hit=lambda *_: np.zeros(3))
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
    pick_tool.end_waiting()


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
