"""Many fruit that are deleted or unlinked at once are no decision."""

from __future__ import annotations

import dataclasses

import bpy
import numpy as np
import pytest
from blender_examples import drawn

from fruitlangs.fruitlangs_addon.panels.step_export import FRUITLANGS_PT_export
from fruitlangs.fruitlangs_addon.panels.step_review import FRUITLANGS_PT_review
from fruitlangs.operators.blender_data import find_owned_object, find_owned_objects
from fruitlangs.operators.data.fruit_objects import REVIEW, list_counted_fruit, read_log
from fruitlangs.operators.data.read_fruits import read_fruits
from fruitlangs.operators.data.stored_review import keep_corrections, review_line
from fruitlangs.operators.steps.show_result import show_result

COUNT = 40


@pytest.fixture
def result(counted, result_of, tmp_path):
    """A row of forty apples, ten on each of four trees."""
    first = counted.fruit_count.fruits[0]
    fruits = [
        dataclasses.replace(
            first,
            id=number + 1,
            center=np.array([0.3 * number, 2.0, 3.0]),
            probability=0.5 + number / 100,
            tree=number // 10 + 1,
            color=np.array([200, 5 * number, 0], np.uint8),
            members=np.array([number] if number < 20 else [], np.int64),
        )
        for number in range(COUNT)
    ]
    fruit_count = dataclasses.replace(counted.fruit_count, fruits=fruits, interval=(30, 50), last_id=COUNT)
    return result_of(counted, tmp_path, fruit_count=fruit_count)


@pytest.fixture
def shown(extension, result):
    show_result(bpy.context, bpy.context.scene, result)
    return bpy.context.scene


def delete(scene, numbers) -> None:
    for item in scene.objects:
        item.select_set(item.get("fruitlangs") == "fruit" and item["id"] in numbers)
    bpy.ops.object.delete()


def delete_collection(scene) -> None:
    delete(scene, range(1, COUNT + 1))
    bpy.data.collections.remove(bpy.data.collections["Fruits"])


def unlink_collection(scene) -> None:
    parent = bpy.data.collections["FruitLangs"]
    parent.children.unlink(bpy.data.collections["Trees"])
    parent.children.unlink(bpy.data.collections["Fruits"])


ACCIDENTS = {"delete": delete_collection, "unlink": unlink_collection}


@pytest.fixture(params=ACCIDENTS)
def emptied(request, shown):
    ACCIDENTS[request.param](shown)
    return shown


def test_many_missing_fruit_are_asked_about_and_not_rejected(emptied, tmp_path):
    path = tmp_path / "a.csv"
    with pytest.raises(
        RuntimeError, match=r"40 of 40 fruit were deleted or unlinked.*restore_fruit\(\) or reject_missing"
    ):
        bpy.ops.fruitlangs.export_csv(filepath=str(path))
    assert not path.exists()
    assert read_log(emptied) == []
    assert review_line(emptied) == "counted 40, 40 of 40 fruit were deleted or unlinked"


def test_the_panels_say_what_is_missing_and_offer_both_answers(emptied):
    panel = drawn(FRUITLANGS_PT_review)
    assert {"restore_fruit", "reject_missing"} <= set(panel.buttons)
    assert "40 of 40 fruit were deleted or unlinked" in panel.text
    assert "Restore or reject them in step 5" in drawn(FRUITLANGS_PT_export).text


def test_restored_fruit_are_what_they_were(emptied, result):
    before = result.fruit_count.fruits
    assert bpy.ops.fruitlangs.restore_fruit() == {"FINISHED"}
    found = read_fruits(emptied).fruits
    for old, new in zip(before, found, strict=True):
        assert (new.id, new.label, new.kind, new.tree) == (old.id, old.label, old.kind, old.tree)
        assert (new.probability, new.views) == (pytest.approx(old.probability), old.views)
        np.testing.assert_allclose(new.center, old.center, atol=1e-5)
        np.testing.assert_allclose(new.axes.T @ new.axes, old.axes.T @ old.axes, atol=1e-6)
        np.testing.assert_array_equal(new.color, old.color)
        np.testing.assert_array_equal(new.members, old.members)
    assert not any(REVIEW in item for item in find_owned_objects(emptied, "fruit"))
    assert review_line(emptied) == "counted 40, 90 % interval 30–50"
    assert keep_corrections(emptied) == []


def test_rejected_missing_fruit_are_one_decision_and_the_zero_is_a_warning(emptied, tmp_path, capfd):
    emptied.fruitlangs.review.reason = "another tree"
    assert bpy.ops.fruitlangs.reject_missing() == {"FINISHED"}
    (entry,) = read_log(emptied)
    assert (entry.action, entry.reason, len(entry.before)) == ("reject", "another tree", 40)
    bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
    said = capfd.readouterr().out
    assert "Warning: Wrote 0 fruit to" in said
    assert "none of the 40 counted fruit is left after the review" in said


def test_a_recount_shows_missing_fruit_again_and_says_so(emptied, result):
    show_result(bpy.context, emptied, result)
    assert len(list_counted_fruit(emptied)) == COUNT
    assert sorted(item.name for item in list_counted_fruit(emptied))[0] == "apple.001"
    assert "40 of 40 fruit were deleted or unlinked and are not rejected" in emptied.fruitlangs.result.notices
    assert read_log(emptied) == []


@pytest.mark.parametrize(("deleted", "is_question"), [(3, False), (4, False), (5, True), (10, True)])
def test_a_tenth_of_the_fruit_may_be_deleted_as_a_decision(shown, deleted, is_question):
    delete(shown, range(1, deleted + 1))
    if is_question:
        with pytest.raises(RuntimeError, match=f"{deleted} of 40 fruit"):
            bpy.ops.fruitlangs.export_csv(filepath="/nowhere/a.csv")
        assert read_log(shown) == []
        return
    keep_corrections(shown)
    assert [len(entry.before) for entry in read_log(shown)] == [deleted]


def test_hidden_and_excluded_fruit_count(shown):
    bpy.data.collections["Fruits"].hide_viewport = True
    for item in list_counted_fruit(shown):
        item.hide_viewport = True
    layer = bpy.context.view_layer.layer_collection.children["FruitLangs"]
    layer.children["Fruits"].exclude = layer.children["Trees"].exclude = True
    assert keep_corrections(shown) == []
    assert read_fruits(shown).count == COUNT


def test_a_copy_made_before_the_accident_is_kept(shown):
    copy = next(each for each in list_counted_fruit(shown) if each["id"] == COUNT).copy()
    shown.collection.objects.link(copy)
    copy.location.x = -5.0
    delete(shown, range(1, COUNT))
    bpy.ops.fruitlangs.restore_fruit()
    assert keep_corrections(shown) == []
    assert sorted(item["id"] for item in list_counted_fruit(shown)) == list(range(1, COUNT + 2))
    assert [(entry.action, entry.reason) for entry in read_log(shown)] == [("add", "copied")]


def test_a_log_that_rejects_most_fruit_is_stated_and_can_be_taken_back(shown, result):
    delete_collection(shown)
    bpy.ops.fruitlangs.reject_missing()
    show_result(bpy.context, shown, result)
    assert "the review rejects 40 of 40 fruit" in shown.fruitlangs.result.notices
    assert "restore_fruit" in drawn(FRUITLANGS_PT_review).buttons
    bpy.ops.fruitlangs.restore_fruit()
    assert len(list_counted_fruit(shown)) == COUNT
    show_result(bpy.context, shown, result)
    assert len(list_counted_fruit(shown)) == COUNT
    assert "rejects" not in shown.fruitlangs.result.notices


def test_decisions_wait_until_missing_fruit_are_answered(shown):
    delete(shown, range(2, COUNT + 1))
    bpy.context.view_layer.objects.active = list_counted_fruit(shown)[0]
    list_counted_fruit(shown)[0].select_set(True)
    with pytest.raises(RuntimeError, match="39 of 40"):
        bpy.ops.fruitlangs.confirm_fruit()
    assert read_log(shown) == []


def test_without_stored_details_deleted_fruit_are_not_invented(shown):
    for row in shown.fruitlangs.review.known:
        row.details = ""
    delete_collection(shown)
    with pytest.raises(RuntimeError, match="import the result again"):
        bpy.ops.fruitlangs.restore_fruit()
    assert list_counted_fruit(shown) == []


def test_a_count_of_nothing_is_exported_with_its_reason(extension, counted_with, result_of, tmp_path, capfd):
    none = counted_with(fruits=0)
    found = dataclasses.replace(none.fruit_count, max_probability=0.3)
    show_result(bpy.context, bpy.context.scene, result_of(none, tmp_path, fruit_count=found))
    bpy.ops.fruitlangs.export_csv(filepath=str(tmp_path / "a.csv"))
    said = capfd.readouterr().out
    assert "Warning: Wrote 0 fruit to" in said
    assert bpy.context.scene.fruitlangs.result.zero_reason in said
    assert find_owned_object(bpy.context.scene, "root") is not None
