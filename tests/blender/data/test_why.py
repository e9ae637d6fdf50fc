"""The audit in Blender: it comes with a count, is kept in the .blend, and the panel leads to what was dropped."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
import pytest
from mathutils import Vector

from fruitlangs.engine.counting.fruit import AuditEntry
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects
from fruitlangs.operators.data.fruit_objects import ADDED, judge
from fruitlangs.operators.data.read_fruits import read_fruits
from fruitlangs.operators.data.stored_audit import AUDIT, read_audit, select_about_fruit
from fruitlangs.operators.data.write import write_blend
from fruitlangs.operators.review.show_cluster import find_cluster_center
from fruitlangs.operators.steps.show_result import show_result
from fruitlangs.operators.steps.shown_source import forget_count

KEPT = AuditEntry(4, "split", "2 touching spheres", (1.15, 2.0, 3.0), 900, (1, 2), 0.15)
BESIDE = AuditEntry(5, "merged", "80% of its points belong to fruit 2", (1.2, 2.0, 3.0), 1200, (2,))
FLAT = AuditEntry(6, "dropped", "flat (0.10 radii thick)", (0.0, 2.5, 3.0), 70)
DUST = AuditEntry(9, "dropped", "3 clusters of fewer than 20 points each", (0.0, 0.0, 0.0), 33)
AUDIT_OF_THREE = [BESIDE, KEPT, FLAT, DUST]
"""Largest first."""


@pytest.fixture
def shown(extension, counted_with, result_of, tmp_path):
    """Three apples in a scene of which a unit is 2 m, counted from these clusters."""
    counted = counted_with(metres_per_unit=2.0)
    fruit_count = dataclasses.replace(counted.fruit_count, audit=[DUST, KEPT, FLAT, BESIDE])
    counted = dataclasses.replace(counted, fruit_count=fruit_count)
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path))
    return counted


class Layout:
    """Takes down what a panel draws: texts, and the clusters that buttons look at."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.buttons: list[Any] = []
        self.properties: list[str] = []

    def label(self, text: str, icon: str = "NONE") -> None:
        self.texts.append(text)

    def operator(self, name: str, icon: str) -> Any:
        self.buttons.append(SimpleNamespace(cluster=None))
        return self.buttons[-1]

    def prop(self, _data: Any, name: str) -> None:
        self.properties.append(name)

    def box(self) -> Layout:
        return self

    def row(self) -> Layout:
        return self

    def column(self, align: bool) -> Layout:
        return self


def drawn() -> Layout:
    from fruitlangs.fruitlangs_addon.panels.audit_panel import FRUITLANGS_PT_review_why

    context = SimpleNamespace(
        scene=bpy.context.scene,
        view_layer=bpy.context.view_layer,
        preferences=SimpleNamespace(system=SimpleNamespace(ui_scale=1.0)),
        region=SimpleNamespace(width=100_000),
    )
    layout = Layout()
    FRUITLANGS_PT_review_why.draw(SimpleNamespace(layout=layout), context)
    return layout


def activate(number: int) -> bpy.types.Object:
    item = next(each for each in find_owned_objects(bpy.context.scene, "fruit") if each["id"] == number)
    bpy.context.view_layer.objects.active = item
    return item


def test_the_audit_of_a_count_comes_back_as_it_was_largest_first(shown):
    assert read_audit(bpy.context.scene) == AUDIT_OF_THREE
    assert read_fruits(bpy.context.scene).audit == AUDIT_OF_THREE


def test_the_audit_goes_with_the_count(shown):
    forget_count(bpy.context.scene)
    assert AUDIT not in bpy.context.scene


def test_a_blend_of_the_command_line_holds_the_audit_without_the_extension(counted, tmp_path):
    fruit_count = dataclasses.replace(counted.fruit_count, audit=[KEPT, FLAT])
    write_blend(tmp_path / "scene.blend", *dataclasses.replace(counted, fruit_count=fruit_count).parts())
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    assert read_audit(bpy.context.scene) == [KEPT, FLAT]


def test_a_fruits_own_cluster_is_reported_before_those_merged_into_it(shown):
    assert select_about_fruit(read_audit(bpy.context.scene), 2) == [KEPT, BESIDE]


def test_the_panel_shows_why_the_active_fruit_was_counted_in_millimetres(shown):
    activate(2)
    assert drawn().texts[:2] == [
        "split, 900 points, fruit 1, 2: 2 touching spheres; mean diameter 300 mm",
        "merged, 1200 points, fruit 2: 80% of its points belong to fruit 2",
    ]


def test_the_panel_says_where_the_audit_gives_nothing_of_a_fruit(shown):
    bpy.context.view_layer.objects.active = None
    assert drawn().texts[0] == "Select a fruit to see why it was counted"
    item = activate(3)
    assert drawn().texts[0] == "The audit has no entry for apple.003"
    judge(item, ADDED)
    assert drawn().texts[0] == "apple.003 was added by the user"


def test_a_file_without_an_audit_says_so(shown):
    del bpy.context.scene[AUDIT]
    assert drawn().texts == ["No audit here. Count again or import the result"]


def test_what_was_dropped_is_listed_with_its_reason_and_a_look_where_it_has_a_place(shown):
    layout = drawn()
    start = layout.texts.index("2 dropped clusters, largest first")
    assert layout.texts[start + 1 :] == ["70 points", FLAT.reason, "33 points", DUST.reason]
    assert [button.cluster for button in layout.buttons] == [FLAT.cluster]
    assert layout.properties == []


def test_many_dropped_clusters_are_shown_six_at_a_time_to_the_last(shown):
    from fruitlangs.operators.data.stored_audit import write_audit

    many = [dataclasses.replace(FLAT, cluster=number, points=100 - number) for number in range(20)]
    write_audit(bpy.context.scene, many)
    assert ([button.cluster for button in drawn().buttons], drawn().properties) == (list(range(6)), ["dropped"])
    bpy.context.scene.fruitlangs.review.dropped = 500
    assert [button.cluster for button in drawn().buttons] == list(range(14, 20))


def test_the_look_goes_to_the_clusters_place_in_the_world(shown, monkeypatch):
    places = []
    monkeypatch.setattr(
        "fruitlangs.operators.review.show_cluster.look_at_point",
        lambda screens, place, distance: places.append((place, distance)),
    )
    assert bpy.ops.fruitlangs.look_at_cluster(cluster=FLAT.cluster) == {"FINISHED"}
    root = find_owned_object(bpy.context.scene, "root")
    np.testing.assert_allclose(places[0][0], root.matrix_world @ Vector(FLAT.center), atol=1e-6)
    assert places[0][1] == pytest.approx(8.0 * 0.4)  # the median fruit is 0.2 units long, a unit is 2 m


def test_a_cluster_is_framed_at_the_size_that_the_user_scaled_the_tree_to(shown, monkeypatch):
    distances = []
    monkeypatch.setattr(
        "fruitlangs.operators.review.show_cluster.look_at_point",
        lambda screens, place, distance: distances.append(distance),
    )
    find_owned_object(bpy.context.scene, "root").scale *= 100.0
    bpy.context.view_layer.update()
    bpy.ops.fruitlangs.look_at_cluster(cluster=FLAT.cluster)
    assert distances == [pytest.approx(8.0 * 0.4 * 100.0)]


@pytest.mark.parametrize("cluster", [DUST.cluster, 77])
def test_a_cluster_without_a_place_is_not_looked_at(shown, cluster):
    assert bpy.ops.fruitlangs.look_at_cluster(cluster=cluster) == {"CANCELLED"}
    assert find_cluster_center(bpy.context.scene, cluster) is None


def test_a_look_wants_the_scenes_root(shown):
    bpy.data.objects.remove(find_owned_object(bpy.context.scene, "root"))
    assert not bpy.ops.fruitlangs.look_at_cluster.poll()
