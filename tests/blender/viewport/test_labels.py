"""Text next to fruit: which ones get it, what it says and where; that it is legible is seen in a window."""

from __future__ import annotations

from types import SimpleNamespace

import blf
import bpy
import numpy as np
import pytest
from mathutils import Matrix

from fruitlangs.operators.blender_data import find_owned_objects
from fruitlangs.operators.drawing import label_drawing
from fruitlangs.operators.drawing.label_drawing import (
    FONT,
    find_label_places,
    label_text,
    list_labelled,
    project,
    select_uncovered,
)
from fruitlangs.operators.steps.show_result import show_result


@pytest.fixture
def fruit(extension, counted, result_of, tmp_path):
    """Three fruit in an empty file."""
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    bpy.context.view_layer.update()
    return find_owned_objects(bpy.context.scene, "fruit")


def viewport(matrix: Matrix, width: int = 400, height: int = 300) -> SimpleNamespace:
    """What a draw handler is given, of a viewport that is not there."""
    view = SimpleNamespace(perspective_matrix=matrix, view_matrix=Matrix.Identity(4))
    layer = bpy.context.view_layer
    return SimpleNamespace(
        region=SimpleNamespace(width=width, height=height),
        region_data=view,
        view_layer=layer,
        scene=bpy.context.scene,
        space_data=None,
    )


def test_what_is_written_is_the_number_the_name_or_the_size(fruit):
    item = fruit[1]
    assert label_text(item, "NUMBER", metric=False) == "2"
    assert label_text(item, "NAME", metric=False) == "apple 2"
    assert label_text(item, "SIZE", metric=False) == "2: 0.2"
    assert label_text(item, "SIZE", metric=True) == "2: 200 mm"


def test_places_behind_the_viewer_and_outside_the_region_are_none():
    matrix = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, -1.0, -0.2], [0, 0, -1.0, 0]])  # looks along -z
    places = np.array([[0.0, 0, -2.0], [1.0, 0.5, -2.0], [0, 0, 2.0], [5.0, 0, -2.0]])
    pixels, depths = project(places, matrix, 400, 300)
    np.testing.assert_allclose(pixels[:2], [[200, 150], [300, 187.5]])
    assert np.isnan(pixels[2:]).all()
    assert depths[0] < project(np.array([[0.0, 0, -3.0]]), matrix, 400, 300)[1][0]


def test_nearer_places_come_first_in_an_orthographic_view_too():
    matrix = np.diag([1.0, 1.0, -0.1, 1.0])
    _, depths = project(np.array([[0.0, 0, 1.0], [0, 0, 5.0]]), matrix, 400, 300)
    assert depths[1] < depths[0]


def test_a_label_that_covers_an_earlier_one_is_left_out():
    boxes = np.array([[0.0, 0, 10, 10], [5, 5, 10, 10], [12, 0, 10, 10], [14, 9, 10, 10]])
    assert select_uncovered(boxes) == [0, 2]  # the second goes; it makes no room for the fourth, which the third covers
    assert select_uncovered(np.zeros((0, 4))) == []


def test_rejected_and_hidden_fruit_have_no_label(fruit):
    context = viewport(Matrix.Identity(4))
    assert list_labelled(context, "NUMBER") == fruit
    fruit[0].select_set(True)
    bpy.context.view_layer.objects.active = fruit[0]
    bpy.ops.fruitlangs.reject_fruit()
    fruit[1].hide_set(True)
    assert list_labelled(context, "NUMBER") == [fruit[2]]


def test_without_labels_only_the_active_fruit_is_marked(fruit):
    bpy.context.view_layer.objects.active = fruit[1]
    assert list_labelled(viewport(Matrix.Identity(4)), "NONE") == [fruit[1]]


def test_the_active_fruit_keeps_its_label_where_a_nearer_one_covers_it(fruit):
    for number, item in enumerate(fruit):
        item.parent, item.matrix_world = None, Matrix.Translation((0.0, 0.0, 0.3 * number))
    bpy.context.view_layer.update()
    blf.size(FONT, 12.0)
    texts = ["1", "2", "3"]
    context = viewport(Matrix.Diagonal((0.1, 0.1, -0.1, 1.0)))
    bpy.context.view_layer.objects.active = None
    assert [index for index, _ in find_label_places(context, fruit, texts)] == [2]
    bpy.context.view_layer.objects.active = fruit[0]
    assert [index for index, _ in find_label_places(context, fruit, texts)] == [0]


def test_a_label_stands_right_of_its_fruit(fruit):
    bpy.context.view_layer.objects.active = None
    fruit[0].parent, fruit[0].matrix_world = None, Matrix.Identity(4)
    bpy.context.view_layer.update()
    blf.size(FONT, 12.0)
    ((_, place),) = find_label_places(viewport(Matrix.Diagonal((0.5, 0.5, -0.1, 1.0))), fruit[:1], ["1"])
    radius = 0.5 * max(fruit[0].dimensions) * 0.5 * 0.5 * 400
    np.testing.assert_allclose(place, [200 + radius + label_drawing.GAP, 150], atol=1e-3)
