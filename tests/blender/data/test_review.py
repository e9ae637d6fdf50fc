"""Every decision on a fruit changes the count, is in the log, can be undone and outlives a recount."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from blender_examples import drawn
from mathutils import Vector

from fruitlangs.engine.counting.accounts.review import replay
from fruitlangs.engine.counting.fruit import KIND_TEXTS
from fruitlangs.engine.errors import SceneError
from fruitlangs.fruitlangs_addon.panels.fruit_list import KIND_ICONS, cells, head, is_shown, rank_items, sign_of
from fruitlangs.fruitlangs_addon.panels.step_review import FRUITLANGS_PT_review
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects, get_attribute
from fruitlangs.operators.data.fruit_objects import (
    REVIEW,
    fruit_collection,
    list_counted_fruit,
    members,
    read_log,
    spot_of,
)
from fruitlangs.operators.data.read_fruits import read_fruits
from fruitlangs.operators.data.stored_review import entry_text, keep_corrections, review_line
from fruitlangs.operators.scene_frame import scene_frame
from fruitlangs.operators.steps.show_result import show_result


@pytest.fixture
def shown(extension, counted, result_of, tmp_path):
    """Three apples .3 apart, of diameters .1, .2 and .3 and probabilities .9, .6 and .7, with an interval of 2 to 5."""
    probabilities = (0.9, 0.6, 0.7)
    fruits = [
        dataclasses.replace(fruit, probability=chance)
        for fruit, chance in zip(counted.fruit_count.fruits, probabilities, strict=True)
    ]
    fruit_count = dataclasses.replace(counted.fruit_count, fruits=fruits, interval=(2, 5), last_id=3)
    show_result(bpy.context, bpy.context.scene, result_of(counted, tmp_path, fruit_count=fruit_count))
    return bpy.context.scene


@pytest.fixture
def again(counted, result_of, tmp_path):
    """Show the same count again, as a recount does, with these fruit."""

    def recount(fruits=None, prompt="apple"):
        found = counted.fruit_count.fruits if fruits is None else fruits
        found = [dataclasses.replace(fruit, label=prompt) for fruit in found]
        fruit_count = dataclasses.replace(counted.fruit_count, fruits=found, interval=(2, 5), last_id=3)
        result = result_of(counted, tmp_path, fruit_count=fruit_count)
        result.origin["prompts"] = [prompt]
        show_result(bpy.context, bpy.context.scene, result)

    return recount


def fruit(number: int) -> bpy.types.Object:
    return next(item for item in find_owned_objects(bpy.context.scene, "fruit") if item["id"] == number)


def select(*numbers: int) -> None:
    for item in bpy.context.selected_objects:
        item.select_set(False)
    for number in reversed(numbers):
        fruit(number).select_set(True)
        bpy.context.view_layer.objects.active = fruit(number)


def numbers() -> list[int]:
    return sorted(item["id"] for item in list_counted_fruit(bpy.context.scene))


def test_the_line_gives_the_machines_count_before_anything_was_reviewed(shown):
    assert review_line(shown) == "counted 3, 90 % interval 2–5"


def test_a_rejected_fruit_is_hidden_and_no_longer_counted_and_can_come_back(shown):
    select(2)
    shown.fruitlangs.review.reason = "a leaf"
    assert bpy.ops.fruitlangs.reject_fruit() == {"FINISHED"}
    assert numbers() == [1, 3]
    assert fruit(2).hide_viewport
    assert fruit(2).hide_render
    assert review_line(shown).startswith("counted 3, after review 2, 90 % interval ")
    entry = read_log(shown)[-1]
    assert (entry.action, entry.reason, [spot.id for spot in entry.before]) == ("reject", "a leaf", [2])
    assert shown.fruitlangs.review.reason == ""
    bpy.context.view_layer.objects.active = fruit(2)
    assert bpy.ops.fruitlangs.reopen_fruit() == {"FINISHED"}
    assert numbers() == [1, 2, 3]
    assert not fruit(2).hide_viewport
    assert REVIEW not in fruit(2)


def test_confirming_all_leaves_no_doubt_below(shown):
    select(1, 2, 3)
    bpy.ops.fruitlangs.confirm_fruit()
    assert review_line(shown) == "counted 3, after review 3, 90 % interval 3–5"
    assert len(read_log(shown)[0].before) == 3


def test_merged_fruit_are_one_with_a_new_number_and_their_gaussians(shown):
    select(2, 3)
    assert bpy.ops.fruitlangs.merge_fruit() == {"FINISHED"}
    assert numbers() == [1, 4]
    assert fruit(4)["label"] == "apple"
    assert fruit(4)[REVIEW] == "added"
    assert bpy.context.selected_objects == [fruit(4)]
    ids = get_attribute(find_owned_object(shown, "gaussians").data, "fruit_id")
    assert ids[:6].tolist() == [1, 1, 4, 4, 4, 4]


def test_merging_wants_two_fruit(shown):
    select(1)
    assert not bpy.ops.fruitlangs.merge_fruit.poll()


def test_a_split_fruit_becomes_as_many_as_asked(shown):
    select(3)
    assert bpy.ops.fruitlangs.split_fruit(parts=3) == {"FINISHED"}
    assert numbers() == [1, 2, 4, 5, 6]
    volume = sum(fruit(number)["diameter"] ** 3 for number in (4, 5, 6))
    assert volume == pytest.approx(0.3**3, rel=1e-4)
    assert [spot.id for spot in read_log(shown)[0].after] == [4, 5, 6]


def test_a_copy_of_a_fruit_is_split_where_it_is_and_takes_no_gaussians(shown):
    item = fruit(1)
    copy = item.copy()
    shown.objects[item.name].users_collection[0].objects.link(copy)
    copy.location.z += 5.0
    own = set(members(shown, item)[0])
    assert own
    assert not len(members(shown, copy)[0])
    for each in shown.objects:
        each.select_set(each == copy)
    bpy.context.view_layer.objects.active = copy
    assert bpy.ops.fruitlangs.split_fruit(parts=2) == {"FINISHED"}
    made = [each for each in list_counted_fruit(shown) if each.get(REVIEW) == "added"]
    assert {round(each.location.z, 3) for each in made} == {round(item.location.z + 5.0, 3)}
    assert set(members(shown, item)[0]) == own


def test_an_added_fruit_is_as_large_as_the_others_where_it_was_put(shown):
    assert bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0)) == {"FINISHED"}
    new = fruit(4)
    assert tuple(new.location) == (5.0, 6.0, 7.0)
    assert new["diameter"] == pytest.approx(0.2)
    assert (new["label"], new["probability"], new[REVIEW]) == ("apple", 1.0, "added")
    assert review_line(shown) == "counted 3, after review 4, 90 % interval 3–5"


def test_an_added_fruit_stays_one_when_it_was_rejected_and_reopened(shown):
    frame = scene_frame(shown)
    counted = [spot_of(item, frame) for item in find_owned_objects(shown, "fruit")]
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    before = review_line(shown)
    bpy.ops.fruitlangs.reject_fruit()
    assert review_line(shown) == "counted 3, after review 3, 90 % interval 2–5"
    bpy.ops.fruitlangs.reopen_fruit()
    assert review_line(shown) == before
    assert not fruit(4).hide_viewport
    assert [item.get(REVIEW, "") for item in find_owned_objects(shown, "fruit")] == ["", "", "", "added"]
    assert replay(read_log(shown), counted).standings == ["", "", "", "added"]
    fruit(4).location.x = 9.0
    keep_corrections(shown)
    assert read_log(shown)[0].after[0].center[0] == pytest.approx(9.0)


@pytest.fixture
def nothing(extension, counted_with, result_of, tmp_path):
    """A count of 0 in a scene of that scale."""

    def nothing(metres_per_unit=None):
        none = counted_with(metres_per_unit=metres_per_unit, fruits=0)
        found = dataclasses.replace(none.fruit_count, max_probability=0.3)
        show_result(bpy.context, bpy.context.scene, result_of(none, tmp_path, fruit_count=found))
        return bpy.context.scene

    return nothing


def test_after_a_count_of_0_a_fruit_is_added_with_the_diameter_that_was_typed(nothing):
    scene = nothing()
    panel = drawn(FRUITLANGS_PT_review)
    assert "add_fruit" in panel.buttons
    assert "diameter" in panel.settings
    with pytest.raises(RuntimeError, match="Enter its diameter below Add first"):
        bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    scene.fruitlangs.review.diameter = 0.25
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    assert fruit(1)["diameter"] == pytest.approx(0.25)
    assert "diameter" not in drawn(FRUITLANGS_PT_review).settings
    assert review_line(scene) == "counted 0, after review 1"


def test_where_the_scale_is_known_the_diameter_is_typed_in_millimetres(nothing):
    scene = nothing(metres_per_unit=0.5)
    assert "diameter_mm" in drawn(FRUITLANGS_PT_review).settings
    scene.fruitlangs.review.diameter = 9.0
    scene.fruitlangs.review.diameter_mm = 80.0
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    assert fruit(1)["diameter"] == pytest.approx(0.08)
    assert fruit(1).scale[0] == pytest.approx(0.16)


def test_where_every_fruit_is_rejected_an_added_one_is_as_large_as_those(shown):
    select(1, 2, 3)
    bpy.ops.fruitlangs.reject_fruit()
    assert "diameter" not in drawn(FRUITLANGS_PT_review).settings
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    assert fruit(4)["diameter"] == pytest.approx(0.2)


def test_a_relabelled_fruit_has_the_name_and_mesh_of_its_new_label(shown):
    select(1, 2)
    assert bpy.ops.fruitlangs.relabel_fruit(label="ripe  apple") == {"FINISHED"}
    assert fruit(1).name == "ripe apple.001"
    assert fruit(1).data == fruit(2).data
    assert fruit(3).data != fruit(1).data
    assert [entry_text(entry).split(" ", 2)[2] for entry in shown.fruitlangs.review.log] == [
        "relabel 1 → ripe apple",
        "relabel 2 → ripe apple",
    ]


def test_relabelling_to_nothing_is_an_error(shown):
    select(1)
    with pytest.raises(RuntimeError, match="Type the label"):
        bpy.ops.fruitlangs.relabel_fruit()


def test_relabelling_several_logs_the_reason_for_each(shown):
    select(1, 2)
    shown.fruitlangs.review.reason = "another tree"
    bpy.ops.fruitlangs.relabel_fruit(label="pear")
    assert [entry.reason for entry in read_log(shown)] == ["another tree", "another tree"]
    assert shown.fruitlangs.review.reason == ""


def test_a_fruit_that_gets_the_label_it_has_keeps_its_name(shown):
    select(2)
    bpy.ops.fruitlangs.relabel_fruit(label="apple")
    assert fruit(2).name == "apple.002"


def test_what_cannot_be_done_is_reported_and_changes_nothing(shown, monkeypatch):
    def missing(*_, **__):
        raise ModuleNotFoundError("No module named 'sklearn'", name="sklearn")

    monkeypatch.setattr("fruitlangs.engine.counting.accounts.review.split", missing)
    select(1)
    with pytest.raises(RuntimeError, match="sklearn"):
        bpy.ops.fruitlangs.split_fruit(parts=2)
    fruit(1).scale = fruit(2).scale = (0.0, 0.0, 0.0)
    select(1, 2)
    with pytest.raises(RuntimeError, match=r"The fruit have no size. Scale one of them up first"):
        bpy.ops.fruitlangs.merge_fruit()
    assert numbers() == [1, 2, 3]
    assert read_log(shown) == []


def test_without_the_scenes_root_nothing_is_decided_and_an_export_says_what_is_gone(shown):
    select(1)
    bpy.data.objects.remove(find_owned_object(shown, "root"))
    for name in ("confirm_fruit", "reject_fruit", "add_fruit", "reopen_fruit"):
        assert not getattr(bpy.ops.fruitlangs, name).poll()
    with pytest.raises(SceneError, match="root empty was deleted"):
        read_fruits(shown)


def test_a_collection_that_the_view_layer_leaves_out_is_named_and_an_added_fruit_is_kept(shown):
    layer = bpy.context.view_layer.layer_collection.children["FruitLangs"].children["Fruits"]
    layer.exclude = True
    assert bpy.ops.fruitlangs.next_uncertain() == {"CANCELLED"}
    shown.fruitlangs.review.active_fruit = 1
    assert bpy.ops.fruitlangs.add_fruit(center=(1.0, 2.0, 3.0)) == {"FINISHED"}
    assert numbers() == [1, 2, 3, 4]
    assert len(read_log(shown)) == 1


def test_fruit_whose_collection_was_deleted_are_listed_where_they_are(shown):
    collection = fruit_collection(shown)
    for item in list(collection.objects):
        shown.collection.objects.link(item)
    bpy.data.collections.remove(collection)
    before = len(bpy.data.collections)
    assert fruit_collection(shown) == shown.collection
    assert len(bpy.data.collections) == before
    select(2)
    assert shown.collection.objects[shown.fruitlangs.review.active_fruit] == fruit(2)
    assert not is_shown(find_owned_object(shown, "root"), "ALL", 0.5, "")
    assert is_shown(fruit(2), "ALL", 0.5, "")


def test_fruit_of_a_linked_file_are_nobodys_here(shown, tmp_path):
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.read_homefile(use_empty=True)
    with bpy.data.libraries.load(str(tmp_path / "a.blend"), link=True) as (_, wanted):
        wanted.collections = ["FruitLangs"]
    bpy.context.scene.collection.children.link(bpy.data.collections["FruitLangs"])
    assert "apple.001" in bpy.context.scene.objects
    assert find_owned_objects(bpy.context.scene, "fruit") == []
    assert fruit_collection(bpy.context.scene) is None
    assert not bpy.ops.fruitlangs.next_uncertain.poll()


def test_next_uncertain_goes_from_the_least_likely_upwards_and_skips_reviewed_fruit(shown):
    visited = []
    for _ in range(4):
        bpy.ops.fruitlangs.next_uncertain()
        visited.append(bpy.context.view_layer.objects.active["id"])
    assert visited == [2, 3, 1, 2]
    bpy.ops.fruitlangs.confirm_fruit()
    bpy.ops.fruitlangs.next_uncertain()
    assert bpy.context.view_layer.objects.active["id"] == 3
    select(1, 2, 3)
    bpy.ops.fruitlangs.confirm_fruit()
    assert not bpy.ops.fruitlangs.next_uncertain.poll()


def test_next_uncertain_passes_over_no_less_certain_fruit_after_a_click_on_another(shown):
    select(3)
    visited = []
    for _ in range(3):
        bpy.ops.fruitlangs.next_uncertain()
        visited.append(bpy.context.view_layer.objects.active["id"])
        select(1)
    assert visited == [2, 3, 1]


def test_next_uncertain_returns_to_a_reopened_fruit_that_it_did_not_show(shown):
    select(2)
    bpy.ops.fruitlangs.reject_fruit()
    bpy.ops.fruitlangs.next_uncertain()
    select(2)
    bpy.ops.fruitlangs.reopen_fruit()
    bpy.ops.fruitlangs.next_uncertain()
    assert bpy.context.view_layer.objects.active["id"] == 2


def test_next_uncertain_says_when_it_starts_again(shown, capfd):
    for _ in range(3):
        bpy.ops.fruitlangs.next_uncertain()
    assert "first one again" not in capfd.readouterr().out
    bpy.ops.fruitlangs.next_uncertain()
    assert "Every fruit that is not reviewed was shown. This is the first one again" in capfd.readouterr().out


def test_a_recount_starts_next_uncertain_from_the_least_certain_again(shown, again, counted):
    for _ in range(2):
        bpy.ops.fruitlangs.next_uncertain()
    again([dataclasses.replace(each, probability=0.1 * each.id) for each in counted.fruit_count.fruits])
    bpy.ops.fruitlangs.next_uncertain()
    assert bpy.context.view_layer.objects.active["id"] == 1


def test_fruit_that_cannot_be_shown_do_not_stop_next_uncertain(shown):
    own = bpy.data.collections.new("Excluded")
    shown.collection.children.link(own)
    own.objects.link(fruit(2))
    fruit_collection(shown).objects.unlink(fruit(2))
    bpy.context.view_layer.layer_collection.children["Excluded"].exclude = True
    assert bpy.ops.fruitlangs.next_uncertain() == {"CANCELLED"}
    assert bpy.ops.fruitlangs.next_uncertain() == {"FINISHED"}
    assert bpy.context.view_layer.objects.active["id"] == 3


@pytest.mark.parametrize("scale", [0.01, 1.0, 100.0])
def test_next_uncertain_frames_the_fruit_at_the_size_that_the_user_scaled_it_to(shown, monkeypatch, scale):
    shots = []
    monkeypatch.setattr(
        "fruitlangs.operators.review.review.look_at_point", lambda _, place, distance: shots.append((place, distance))
    )
    root = find_owned_object(shown, "root")
    root.scale = [scale * side for side in root.scale]
    root.location = (7.0, 8.0, 9.0)
    bpy.context.view_layer.update()
    bpy.ops.fruitlangs.next_uncertain()
    place, distance = shots[0]
    np.testing.assert_allclose(place, fruit(2).matrix_world.translation, rtol=1e-5)
    assert distance == pytest.approx(8.0 * 0.2 * scale, rel=1e-5)


def test_a_viewport_does_not_clip_what_it_is_moved_to():
    from fruitlangs.operators.viewport.viewport import look_at_point

    screens = [screen for screen in bpy.data.screens for area in screen.areas if area.type == "VIEW_3D"]
    spaces = [area.spaces.active for screen in screens for area in screen.areas if area.type == "VIEW_3D"]
    assert spaces
    for distance in (0.001, 1e5):
        look_at_point(screens, Vector((0.0, 0.0, 0.0)), distance)
        assert all(space.clip_start < 0.1 * distance and space.clip_end > 10.0 * distance for space in spaces)


def test_the_icon_of_every_kind_is_chosen_by_its_key(shown):
    for kind, icon in (("single", "MESH_UVSPHERE"), ("small", "DOT"), ("compound-part", "META_BALL")):
        fruit(1)["kind"] = kind
        assert sign_of(fruit(1), wide=False) == icon
        assert sign_of(fruit(1), wide=True) == "BLANK1"
    assert set(KIND_ICONS) == set(KIND_TEXTS)
    fruit(1)[REVIEW] = "rejected"
    assert sign_of(fruit(1), wide=False) == "X"


def test_the_list_and_the_viewport_select_each_other(shown):
    review, collection = shown.fruitlangs.review, bpy.data.collections["Fruits"]
    review.active_fruit = 2
    assert bpy.context.selected_objects == [collection.objects[2]]
    select(1)
    assert collection.objects[review.active_fruit] == fruit(1)
    bpy.context.view_layer.objects.active = find_owned_object(shown, "root")
    assert review.active_fruit == -1


def test_a_recount_keeps_every_decision(shown, again, counted):
    select(1)
    bpy.ops.fruitlangs.reject_fruit()
    select(2)
    bpy.ops.fruitlangs.split_fruit(parts=2)
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    before = {item["id"]: (tuple(item.location), item.get(REVIEW)) for item in find_owned_objects(shown, "fruit")}
    again()
    after = {item["id"]: (tuple(item.location), item.get(REVIEW)) for item in find_owned_objects(shown, "fruit")}
    assert after == before
    assert numbers() == [3, 4, 5, 6]


def test_what_was_decided_on_apples_says_nothing_of_pears_and_holds_when_apples_are_counted_again(shown, again):
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    select(1)
    bpy.ops.fruitlangs.reject_fruit()
    again(prompt="pear")
    assert numbers() == [1, 2, 3]
    assert review_line(shown) == "counted 3, 90 % interval 2–5"
    assert "2 decisions on apple are kept for the next count of them" in shown.fruitlangs.result.notices
    again()
    assert numbers() == [2, 3, 4]


def test_a_recount_keeps_a_made_fruit_where_and_as_large_as_the_user_put_it_since(shown, again):
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    select(4)
    bpy.ops.fruitlangs.relabel_fruit(label="ripe apple")
    fruit(4).location.x, fruit(4).scale = 9.0, (0.5, 0.5, 0.5)
    again()
    assert tuple(fruit(4).location) == (9.0, 6.0, 7.0)
    assert fruit(4)["diameter"] == pytest.approx(0.5)
    assert fruit(4)["label"] == "ripe apple"


def test_a_made_fruit_whose_number_the_count_took_is_corrected_by_its_new_one(shown, again, counted):
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    new = dataclasses.replace(counted.fruit_count.fruits[0], id=4, center=np.array([-3.0, 0.0, 0.0]))
    found = [*counted.fruit_count.fruits, new]
    again(found)
    assert numbers() == [1, 2, 3, 4, 5]
    fruit(5).location.x = 9.0
    again(found)
    assert (fruit(4).location.x, fruit(5).location.x) == (-3.0, 9.0)


def test_after_a_recount_made_fruit_still_have_their_gaussians(shown, again):
    select(2, 3)
    bpy.ops.fruitlangs.merge_fruit()
    again()
    assert get_attribute(find_owned_object(shown, "gaussians").data, "fruit_id")[:6].tolist() == [1, 1, 4, 4, 4, 4]
    select(4)
    bpy.ops.fruitlangs.split_fruit(parts=2)
    again()
    assert set(get_attribute(find_owned_object(shown, "gaussians").data, "fruit_id")[2:6]) <= {5, 6}


def test_a_recount_that_renumbers_keeps_decisions_by_place(shown, again, counted):
    select(1)
    bpy.ops.fruitlangs.reject_fruit()
    again([dataclasses.replace(each, id=each.id + 10) for each in counted.fruit_count.fruits])
    assert [item["id"] for item in find_owned_objects(shown, "fruit") if item.get(REVIEW) == "rejected"] == [11]


def test_a_decision_about_a_fruit_that_is_gone_is_reported_and_stays_in_the_log(shown, again, counted):
    select(3)
    bpy.ops.fruitlangs.confirm_fruit()
    again(counted.fruit_count.fruits[:2])
    assert "confirm of 3: no longer found" in shown.fruitlangs.result.notices
    assert len(read_log(shown)) == 1


def delete(*doomed: int) -> None:
    """As X does."""
    select(*doomed)
    bpy.ops.object.delete()


def copy_of(number: int, place: tuple[float, float, float]) -> bpy.types.Object:
    """As Shift-D and a move do."""
    select(number)
    bpy.ops.object.duplicate()
    made = bpy.context.view_layer.objects.active
    made.location = place
    return made


def told(scene) -> list[tuple]:
    """The log in short: action, reason, numbers before and after."""
    return [
        (each.action, each.reason, *([spot.id for spot in spots] for spots in (each.before, each.after)))
        for each in read_log(scene)
    ]


def test_a_deleted_fruit_is_rejected_in_the_log_and_stays_so_after_a_recount(shown, again):
    fruit(2).location.x = 9.0  # the machine finds it where it found it before
    select(1)
    bpy.ops.fruitlangs.confirm_fruit()
    delete(2)
    again()
    assert told(shown)[1:] == [("reject", "deleted", [2], [])]
    assert numbers() == [1, 3]
    assert fruit(2)[REVIEW] == "rejected"
    assert "deleted by hand and rejected in the log: 2" in shown.fruitlangs.result.notices
    again()
    assert len(read_log(shown)) == 2


def test_a_copied_fruit_is_added_in_the_log_and_a_recount_keeps_it_where_it_is(shown, again):
    copy_of(2, (9.0, 6.0, 7.0))
    again()
    assert told(shown) == [("add", "copied", [], [4])]
    assert numbers() == [1, 2, 3, 4]
    assert tuple(fruit(4).location) == (9.0, 6.0, 7.0)
    assert fruit(4)[REVIEW] == "added"
    assert "copied by hand and added in the log: 4" in shown.fruitlangs.result.notices


def test_the_next_decision_logs_what_was_done_by_hand_first_and_the_copy_stays_selected(shown):
    made = copy_of(2, (9.0, 6.0, 7.0))
    bpy.ops.fruitlangs.relabel_fruit(label="pear")
    assert [each[0] for each in told(shown)] == ["add", "relabel"]
    assert (made["id"], made.name, made.get("probability")) == (4, "pear.004", None)
    assert bpy.context.selected_objects == [made] == [bpy.context.view_layer.objects.active]
    assert fruit(2)["probability"] == pytest.approx(0.6)


def test_of_a_fruit_and_its_copy_the_one_that_stayed_is_the_machines(shown):
    select(2)
    bpy.ops.object.duplicate()
    fruit(2).name, bpy.context.view_layer.objects.active.name = "z", "a"
    bpy.data.objects["a"].location.x = 9.0
    select(3)
    bpy.ops.fruitlangs.confirm_fruit()
    assert (bpy.data.objects["z"]["id"], bpy.data.objects["apple.004"].location.x) == (2, 9.0)


def test_deleted_parts_of_a_split_stay_deleted_after_a_recount(shown, again):
    select(3)
    bpy.ops.fruitlangs.split_fruit(parts=2)
    fruit(5).location.x += 4.0
    select(1)
    bpy.ops.fruitlangs.confirm_fruit()
    delete(5)
    again()
    assert numbers() == [1, 2, 4]


def test_fruit_merged_and_split_by_the_panel_are_neither_deleted_nor_copied(shown, again):
    select(2, 3)
    bpy.ops.fruitlangs.merge_fruit()
    bpy.ops.fruitlangs.split_fruit(parts=2)
    select(1)
    bpy.ops.fruitlangs.reject_fruit()
    bpy.data.objects.remove(fruit(1))  # it does not count any more
    again()
    assert [each[0] for each in told(shown)] == ["merge", "split", "reject"]


def test_a_fruit_deleted_after_a_recount_that_renumbered_is_the_one_that_was_there(shown, again, counted):
    again([dataclasses.replace(each, id=4 - each.id) for each in counted.fruit_count.fruits])
    gone = tuple(fruit(3).location)
    delete(3)
    bpy.ops.fruitlangs.add_fruit(center=(5.0, 6.0, 7.0))
    np.testing.assert_allclose(read_log(shown)[0].before[0].center, gone, atol=1e-6)


def test_who_deletes_the_whole_scene_has_judged_no_fruit(shown, again):
    bpy.data.batch_remove(list(shown.objects))
    again()
    assert (numbers(), read_log(shown)) == ([1, 2, 3], [])


def test_an_export_logs_what_was_done_by_hand_and_undo_takes_both_back(shown, tmp_path):
    bpy.ops.ed.undo_push(message="before")
    delete(1, 2)
    bpy.ops.ed.undo_push(message="Delete")
    bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
    assert len((tmp_path / "a.csv").read_text().splitlines()) == 2
    assert told(shown) == [("reject", "deleted", [1, 2], [])]
    bpy.ops.ed.undo()
    scene = bpy.context.scene
    assert (numbers(), read_log(scene)) == ([1, 2, 3], [])
    bpy.ops.ed.redo()
    bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
    assert told(bpy.context.scene) == [("reject", "deleted", [1, 2], [])]


def test_numbers_of_fruit_that_users_made_are_never_given_twice(shown):
    select(2, 3)
    bpy.ops.fruitlangs.merge_fruit()
    bpy.ops.fruitlangs.split_fruit(parts=2)
    assert numbers() == [1, 5, 6]


@pytest.mark.parametrize(
    ("operator", "arguments", "chosen"),
    [
        ("reject_fruit", {}, (2,)),
        ("confirm_fruit", {}, (2,)),
        ("merge_fruit", {}, (2, 3)),
        ("split_fruit", {"parts": 2}, (3,)),
        ("add_fruit", {"center": (5.0, 6.0, 7.0)}, ()),
        ("relabel_fruit", {"label": "pear"}, (1,)),
    ],
)
def test_every_decision_is_taken_back_by_undo_and_made_again_by_redo(shown, operator, arguments, chosen):
    def told():
        scene = bpy.context.scene
        items = {
            item.name: (item["label"], item.get(REVIEW), item.hide_viewport)
            for item in find_owned_objects(scene, "fruit")
        }
        return items, len(scene.fruitlangs.review.log)

    select(*chosen)
    before = told()
    bpy.ops.ed.undo_push(message="before")
    getattr(bpy.ops.fruitlangs, operator)(**arguments)
    bpy.ops.ed.undo_push(message="decided")
    after = told()
    assert after != before
    bpy.ops.ed.undo()
    assert told() == before
    bpy.ops.ed.redo()
    assert told() == after


def test_a_review_is_in_the_saved_file(shown, tmp_path):
    select(2)
    bpy.ops.fruitlangs.reject_fruit(reason="a leaf")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "a.blend"))
    assert numbers() == [1, 3]
    (entry,) = read_log(bpy.context.scene)
    assert (entry.action, entry.reason) == ("reject", "a leaf")
    np.testing.assert_allclose(entry.before[0].center, [1.3, 2.0, 3.0], atol=1e-6)


def test_a_fruit_that_the_user_moved_is_decided_on_where_it_stands(shown):
    fruit(1).location.x = 9.0
    select(1)
    bpy.ops.fruitlangs.confirm_fruit()
    assert read_log(shown)[0].before[0].center[0] == pytest.approx(9.0)


def test_rows_give_number_size_probability_share_and_kind(shown):
    assert cells(fruit(2), metric=False) == ["2 apple", "0.2", "0.60", "25%", "single"]
    assert (head(metric=True)[1], cells(fruit(1), metric=True)[1]) == ("Ø mm", "100")
    assert len(head(metric=False)) == len(cells(fruit(2), metric=False))


def test_the_list_filters_by_doubt_and_sorts(shown):
    items = [fruit(number) for number in (1, 2, 3)]
    assert [is_shown(item, "DOUBTFUL", 0.65, "") for item in items] == [False, True, False]
    select(2)
    bpy.ops.fruitlangs.reject_fruit()
    assert [is_shown(item, "OPEN", 0.8, "") for item in items] == [True, False, True]
    assert [is_shown(item, "REJECTED", 0.8, "") for item in items] == [False, True, False]
    assert [is_shown(item, "ALL", 0.8, "apple.003") for item in items] == [False, False, True]
    assert rank_items(items, "probability") == [2, 0, 1]
    assert rank_items(items, "diameter") == [0, 1, 2]


def test_reviews_of_two_scenes_in_one_file_are_apart(shown, counted, result_of, tmp_path):
    other = bpy.data.scenes.new("Row 2")
    show_result(bpy.context, other, result_of(counted, tmp_path))
    select(2)
    bpy.ops.fruitlangs.reject_fruit()
    assert (len(list_counted_fruit(shown)), len(list_counted_fruit(other))) == (2, 3)
    assert len(read_log(other)) == 0


def test_fruit_far_apart_are_not_merged(shown):
    fruit(3).location.y += 2.0
    select(1, 3)
    with pytest.raises(RuntimeError, match=r"Fruit 1 and 3 are .* fruit lengths apart"):
        bpy.ops.fruitlangs.merge_fruit()
    assert numbers() == [1, 2, 3]
    assert read_log(shown) == []


def test_an_old_merge_of_fruit_far_apart_is_stated_and_not_made(shown, again):
    from fruitlangs.engine.counting.accounts.review import Decision, Spot
    from fruitlangs.operators.data.fruit_objects import write_log

    one, two, _ = (spot_of(item, scene_frame(shown)) for item in find_owned_objects(shown, "fruit"))
    far = dataclasses.replace(two, center=two.center + 9.0)
    write_log(shown, Decision("merge", "2026-05-01", "", (one, far), (Spot(9, "apple", two.center, np.eye(3)),)))
    again()
    assert numbers() == [1, 2, 3]
    assert "fruit lengths apart, so they are not parts of one fruit" in shown.fruitlangs.result.notices


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"center": (5.0, 6.0, 7.0), "diameter": 40.0}, "new fruit is 200 times the usual one"),
        ({"center": (5.0, 6.0, 7.0), "diameter": 0.001}, "new fruit is 0.005 times the usual one"),
        ({"center": (500.0, 6.0, 7.0)}, "times as far from the middle of the photos"),
    ],
)
def test_an_added_fruit_of_another_world_is_refused(shown, given, reason):
    with pytest.raises(RuntimeError, match=reason):
        bpy.ops.fruitlangs.add_fruit(**given)
    assert numbers() == [1, 2, 3]
    assert read_log(shown) == []


def test_a_split_into_crumbs_is_refused(shown):
    fruit(1).scale *= 0.5
    select(1)
    with pytest.raises(RuntimeError, match="diameter of 12 parts is"):
        bpy.ops.fruitlangs.split_fruit(parts=12)
    assert numbers() == [1, 2, 3]


@pytest.mark.parametrize("edit", ["move", "scale"])
def test_a_fruit_moved_or_scaled_out_of_this_world_is_neither_confirmed_nor_exported(shown, edit, tmp_path):
    if edit == "move":
        fruit(2).location.x = 500.0
    else:
        fruit(2).scale *= 30.0
    select(2)
    with pytest.raises(RuntimeError, match=r"apple\.002"):
        bpy.ops.fruitlangs.confirm_fruit()
    with pytest.raises(RuntimeError, match=r"apple\.002"):
        bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
    assert read_log(shown) == []
