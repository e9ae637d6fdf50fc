"""Our drawing in viewports: when it is, and what the legend says."""

from __future__ import annotations

from types import SimpleNamespace

import bpy
import pytest
from blender_examples import written

import fruitlangs
from fruitlangs.operators.data.write_gaussians import ASKED
from fruitlangs.operators.drawing import label_drawing, legend, splat_drawing
from fruitlangs.operators.photos import photo_backgrounds
from fruitlangs.operators.viewport import appearance, viewport
from fruitlangs.operators.viewport.gaussian_nodes import PROBABILITY_RAMP
from fruitlangs.operators.viewport.viewport import Drawing

DRAWINGS = (label_drawing.drawing, legend.drawing, photo_backgrounds._drawing, splat_drawing._drawing)


def test_background_mode_draws_nothing():
    fruitlangs.register()
    assert [drawing._handle for drawing in DRAWINGS] == [None] * len(DRAWINGS)
    fruitlangs.unregister()


def test_a_drawing_is_added_once_and_goes(monkeypatch):
    added, removed = [], []
    space = SimpleNamespace(
        draw_handler_add=lambda *given: added.append(given) or len(added),
        draw_handler_remove=lambda handle, region: removed.append((handle, region)),
    )
    window = SimpleNamespace(app=SimpleNamespace(background=False), types=SimpleNamespace(SpaceView3D=space))
    monkeypatch.setattr(viewport, "bpy", window)
    monkeypatch.setattr(viewport, "redraw_viewports", lambda: None)
    drawing = Drawing(print, "POST_VIEW")
    for action in (drawing.start, drawing.start, drawing.stop, drawing.stop):
        action()
    assert added == [(print, (), "WINDOW", "POST_VIEW")]
    assert removed == [(1, "WINDOW")]


@pytest.fixture
def answered(extension, counted):
    """A Blender scene whose Gaussians answered to 'apple', not 'leaf'."""
    item = written(counted)
    item.data[ASKED] = "apple, plum | leaf"
    bpy.context.scene.fruitlangs.config.count.threshold = 0.3
    return bpy.context.scene


def test_the_legend_says_the_words_and_the_threshold(answered):
    assert legend.legend_of(answered) == legend.Legend("apple, plum", pytest.approx(0.3))
    assert legend.legend_of(answered).title == "probability of apple, plum"


def test_there_is_no_legend_where_nothing_is_lit(answered, monkeypatch):
    settings, item = answered.fruitlangs, appearance.find_owned_objects(answered, "gaussians")[0]
    settings.look.highlight = False
    assert legend.legend_of(answered) is None
    settings.look.highlight, settings.look.style = True, "NONE"
    assert legend.legend_of(answered) is None
    settings.look.style = "ELLIPSOIDS"
    assert legend.legend_of(answered) is not None
    monkeypatch.setattr(legend, "has_preview", lambda _: True)
    assert legend.legend_of(answered) is None
    monkeypatch.undo()
    del item.data[ASKED]
    assert legend.legend_of(answered) is None


def test_the_bar_goes_from_the_colour_at_the_threshold_to_that_of_certainty():
    places, colors = zip(*legend.bar_colors(), strict=True)
    assert (places[0], places[-1]) == (0.0, 1.0)
    assert list(places) == sorted(places)
    assert colors[-1] == (*PROBABILITY_RAMP[-1][1], 1.0)
    assert colors[0] == (0.485, 0.480, 0.475, 0.75)


def test_only_a_screen_that_shows_the_scene_is_turned_to_it(monkeypatch):
    shown, other = bpy.context.scene, bpy.data.scenes.new("Other")
    context = SimpleNamespace(screen="screen", scene=shown)
    assert viewport.find_screens(context, shown) == []
    monkeypatch.setattr(viewport, "has_window", lambda: True)
    assert viewport.find_screens(context, shown) == ["screen"]
    assert viewport.find_screens(context, other) == []
    bpy.data.scenes.remove(other)
