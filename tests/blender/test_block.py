"""A block of trees opens as one scene, and reviews of its trees go into its tables."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
import pytest

from fruitlangs.engine.block.inputs import read_inputs
from fruitlangs.engine.block.ledger import Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry
from fruitlangs.engine.block.publish import publish_block
from fruitlangs.engine.block.reviews import Review, read_review, write_review
from fruitlangs.engine.block.trees import read_counts
from fruitlangs.engine.counting.accounts.review import Decision
from fruitlangs.engine.pipeline import count_scene
from fruitlangs.fruitlangs_addon.panels.block_panel import cells, icon_of
from fruitlangs.operators.blender_data import find_owned_objects, get_attribute, set_attribute
from fruitlangs.operators.block.block import OVERVIEW, TREE_OF
from fruitlangs.operators.block.overview import ShownResult, read_overview
from fruitlangs.operators.block.write_overview import PROBABILITIES
from fruitlangs.operators.data.fruit_objects import REJECTED, format_now, list_counted_fruit, read_log, write_log
from fruitlangs.operators.data.write import SET_ID


@pytest.fixture(scope="module")
def block(counted_balls: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trees, a row of two trees, and a tree that failed."""
    from conftest import balls_config

    folder = tmp_path_factory.mktemp("orchard") / "block"
    names = ("one", "two", "row", "lost")
    trees = [
        TreeEntry(id=name, source=folder / name, prompt=("apple",), row="A" if name == "row" else "B") for name in names
    ]
    ledger = Ledger(folder)
    ledger.write_trees(trees)
    for tree in trees[:2]:
        shutil.copytree(counted_balls.out, ledger.result(tree).path)
    config = replace(balls_config(), count=replace(balls_config().count, trees=2))
    count_scene(counted_balls.out, ["apple"], ledger.result(trees[2]).path, config=config)
    for tree in trees[:3]:
        ledger.write(tree, TreeState(stage="done", fingerprint=tree.fingerprint))
    lost = TreeState(stage="failed", fingerprint=trees[3].fingerprint, reason="no photos")
    ledger.write(trees[3], lost)
    publish_block(ledger, all_trees=40, density=900.0)
    return folder


@pytest.fixture
def opened(block: Path, tmp_path: Path, extension: Any) -> Path:
    """A copy of the block, opened."""
    copy = tmp_path / "block"
    shutil.copytree(block, copy)
    bpy.ops.fruitlangs.open_block(directory=str(copy))
    return copy


def shown_of(block: Path) -> list[ShownResult]:
    ledger = Ledger(block)
    return read_overview(ledger, read_counts(ledger))


def trees_of(scene: bpy.types.Scene) -> dict[str, Any]:
    return {tree.name: tree for tree in scene.fruitlangs.block.trees}


def open_tree(name: str) -> bpy.types.Scene:
    """Open a tree of the block in the current scene, as the button does; returns its Blender scene."""
    scene = bpy.context.scene
    block = scene.fruitlangs.block
    block.active = [tree.name for tree in block.trees].index(name)
    bpy.ops.fruitlangs.open_tree()
    return next(each for each in bpy.data.scenes if each.get(TREE_OF) == block.trees[block.active].folder)


def test_a_block_is_one_scene_with_a_collection_for_each_tree(opened: Path) -> None:
    scene = bpy.context.scene
    names = [each.name for each in scene.collection.children_recursive]
    assert {"Orchard", "one", "two", "row", "row-1", "row-2", "lost"} <= set(names)
    assert [cells(tree) for tree in scene.fruitlangs.block.trees][-1] == ["no photos"]
    for item in find_owned_objects(scene, "block-fruit"):
        assert len(item.data.vertices) == 42 * max(trees_of(scene)[item["fruitlangs_tree"]].counted, 0)
    assert (
        sum(tree.counted for tree in trees_of(scene).values() if tree.folder == "row") == trees_of(scene)["one"].counted
    )


def test_trees_that_the_user_placed_or_hid_stay_so_when_the_tables_are_updated(opened: Path) -> None:
    scene = bpy.context.scene
    roots = {item["fruitlangs_result"]: item for item in find_owned_objects(scene, "block-root")}
    unmoved = np.array(roots["two"].matrix_basis)
    roots["one"].location.y += 9.0
    roots["one"].scale = [3.0 * side for side in roots["one"].scale]
    placed = np.array(roots["one"].matrix_basis)
    bpy.data.objects["two fruit"].hide_render = True
    assert bpy.ops.fruitlangs.update_block() == {"FINISHED"}
    roots = {item["fruitlangs_result"]: item for item in find_owned_objects(scene, "block-root")}
    np.testing.assert_allclose(np.array(roots["one"].matrix_basis), placed, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(np.array(roots["two"].matrix_basis), unmoved)
    hidden = {item.name: item.hide_render for item in find_owned_objects(scene, "block-fruit")}
    assert hidden == {name: name == "two fruit" for name in hidden}


def test_the_placement_of_another_blocks_trees_is_not_used(opened: Path) -> None:
    scene = bpy.context.scene
    for item in find_owned_objects(scene, "block-root"):
        item.location.y += 9.0
        item["fruitlangs_result"] = f"other {item['fruitlangs_result']}"
    bpy.ops.fruitlangs.open_block()
    assert all(abs(item.matrix_basis.translation.y) < 5.0 for item in find_owned_objects(scene, "block-root"))


def test_fruit_are_where_the_result_has_them_and_trees_do_not_overlap(opened: Path, counted_balls: Any) -> None:
    scene = bpy.context.scene
    bpy.context.view_layer.update()
    item = next(each for each in find_owned_objects(scene, "block-fruit") if each["fruitlangs_tree"] == "one")
    vertices = np.array([vertex.co for vertex in item.data.vertices]).reshape(-1, 42, 3)
    np.testing.assert_allclose(vertices.mean(axis=1), counted_balls.fruit_count.centers, atol=1e-4)
    sizes = np.linalg.norm(vertices - vertices.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    np.testing.assert_allclose(2.0 * sizes, counted_balls.fruit_count.diameters, rtol=0.05)
    boxes = []
    for each in find_owned_objects(scene, "block-fruit"):
        if each.name.startswith(("one", "two")):
            world = np.array([each.matrix_world @ vertex.co for vertex in each.data.vertices])
            boxes.append((world.min(axis=0), world.max(axis=0)))
    (low, high), (next_low, next_high) = boxes
    assert (high[0] < next_low[0]) or (next_high[0] < low[0])


def test_the_colours_show_the_tree_or_the_probability(opened: Path) -> None:
    scene = bpy.context.scene

    def colors() -> list[np.ndarray]:
        return [
            np.unique(get_attribute(item.data, "fruit color"), axis=0)
            for item in find_owned_objects(scene, "block-fruit")
            if len(item.data.vertices)
        ]

    by_tree = colors()
    assert [len(each) for each in by_tree] == [1] * len(by_tree)
    assert len(np.unique(np.concatenate(by_tree), axis=0)) == len(by_tree)
    for item in find_owned_objects(scene, "block-fruit"):  # the fruit of these trees are all certain
        set_attribute(item.data, PROBABILITIES, "FLOAT", np.linspace(0.5, 1.0, len(item.data.vertices)))
    scene.fruitlangs.block.colors = "PROBABILITY"
    assert max(len(each) for each in colors()) > 1


def test_a_review_of_a_tree_goes_into_the_tables_and_is_there_when_the_tree_is_opened_again(opened: Path) -> None:
    overview = bpy.context.scene
    before = trees_of(overview)["two"].counted
    tree = open_tree("two")
    assert tree[OVERVIEW] == overview
    assert len(list_counted_fruit(tree)) == before
    with bpy.context.temp_override(scene=tree, view_layer=tree.view_layers[0]):
        first = find_owned_objects(tree, "fruit")[0]
        tree.view_layers[0].objects.active = first
        first.select_set(True, view_layer=tree.view_layers[0])
        bpy.ops.fruitlangs.reject_fruit(reason="a leaf")
    bpy.ops.fruitlangs.show_block()
    assert bpy.context.scene == overview
    bpy.ops.fruitlangs.update_block()
    assert cells(trees_of(overview)["two"]) == [str(before), str(before - 1)]
    assert cells(trees_of(overview)["one"]) == [str(before), ""]
    rows = {row["tree"]: row for row in csv.DictReader((opened / "orchard.csv").open())}
    assert (rows["two"]["count"], rows["two"]["reviewed"]) == (str(before), str(before - 1))
    assert '"trees": 40' in (opened / "orchard.json").read_text()
    shown = [item for item in find_owned_objects(overview, "block-fruit") if item["fruitlangs_tree"] == "two"]
    assert len(shown[0].data.vertices) == 42 * (before - 1)

    bpy.data.scenes.remove(tree)
    again = open_tree("two")
    assert [item.get("review") for item in find_owned_objects(again, "fruit")].count(REJECTED) == 1
    assert [entry.reason for entry in again.fruitlangs.review.log] == ["a leaf"]
    with bpy.context.temp_override(scene=again, view_layer=again.view_layers[0]):
        again.view_layers[0].objects.active = next(o for o in find_owned_objects(again, "fruit") if o.get("review"))
        bpy.ops.fruitlangs.reopen_fruit()
    bpy.ops.fruitlangs.show_block()
    bpy.ops.fruitlangs.update_block()
    assert cells(trees_of(overview)["two"]) == [str(before), str(before)]
    bpy.data.scenes.remove(again)


def reject_one(tree: bpy.types.Scene) -> None:
    """Reject the first fruit of a tree, in its Blender scene."""
    with bpy.context.temp_override(scene=tree, view_layer=tree.view_layers[0]):
        first = find_owned_objects(tree, "fruit")[0]
        tree.view_layers[0].objects.active = first
        first.select_set(True, view_layer=tree.view_layers[0])
        bpy.ops.fruitlangs.reject_fruit()


def store_review(block: Path, name: str) -> Path:
    """Reject a fruit of a tree, store that review and close the tree; returns the folder of its result."""
    tree = open_tree(name)
    reject_one(tree)
    bpy.ops.fruitlangs.show_block()
    bpy.ops.fruitlangs.update_block()
    bpy.data.scenes.remove(tree)
    return Ledger(block).folder(name).path


@pytest.mark.parametrize("name", ["fruits.json", "cameras.json", "gaussians.ply"])
def test_a_block_is_shown_although_the_result_of_a_tree_is_damaged(name: str, block: Path, tmp_path: Path) -> None:
    copy = tmp_path / "block"
    shutil.copytree(block, copy)
    before = {tree.name: tree.counted for each in shown_of(copy) for tree in each.trees}
    (copy / "trees" / "two" / name).write_text("{")
    shown = {tree.name: tree for each in shown_of(copy) for tree in each.trees}
    assert name in shown["two"].problem
    assert {own: tree.counted for own, tree in shown.items()} == {**before, "two": -1}


def count_again(result: Path) -> str:
    """Give a result the id of another count; returns it."""
    document = json.loads((result / "fruits.json").read_text())
    document["set_id"] = "counted-again"
    (result / "fruits.json").write_text(json.dumps(document))
    return "counted-again"


def test_a_tree_with_a_damaged_review_is_an_error_at_every_try_until_it_is_mended(opened: Path) -> None:
    review = store_review(opened, "two") / "review.json"
    whole = review.read_text()
    review.write_text("{")
    overview = bpy.context.scene
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"review.json is damaged"):
            open_tree("two")
        assert list(bpy.data.scenes) == [overview]
    review.write_text(whole)
    assert len(read_log(open_tree("two"))) == 1


def test_a_tree_whose_result_cannot_be_imported_leaves_no_scene_and_its_review_as_it_was(opened: Path) -> None:
    result = store_review(opened, "two")
    gaussians = result / "gaussians.ply"
    whole, review = gaussians.read_bytes(), (result / "review.json").read_text()
    gaussians.write_bytes(b"ply")
    overview = bpy.context.scene
    with pytest.raises(RuntimeError, match=r"gaussians.ply"):
        open_tree("two")
    assert (list(bpy.data.scenes), bpy.context.scene) == ([overview], overview)
    gaussians.write_bytes(whole)
    bpy.ops.fruitlangs.update_block()
    assert (result / "review.json").read_text() == review


def test_a_tree_whose_import_was_cancelled_is_not_in_the_tables_and_is_imported_when_opened_again(opened: Path) -> None:
    store_review(opened, "two")
    overview = bpy.context.scene
    cancelled = bpy.data.scenes.new("two")
    cancelled[TREE_OF], cancelled[OVERVIEW] = "two", overview
    write_log(cancelled, Decision("reject", format_now(), ""))
    reviewed = trees_of(overview)["two"].reviewed
    bpy.ops.fruitlangs.update_block()
    assert trees_of(overview)["two"].reviewed == reviewed
    tree = open_tree("two")
    assert (len(list_counted_fruit(tree)), len(read_log(tree))) == (reviewed, 1)
    assert len(bpy.data.scenes) == 2


def test_a_tree_that_was_counted_again_since_it_was_opened_keeps_the_review_of_the_newer_count(
    opened: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    overview, result = bpy.context.scene, Ledger(opened).folder("two").path
    tree = open_tree("two")
    reject_one(tree)
    bpy.ops.fruitlangs.show_block()
    newer = count_again(result)
    write_review(result, newer, Review(fruits=[]))
    bpy.ops.fruitlangs.update_block()
    assert "another count than the orchard has, so no review was written: two" in capfd.readouterr().out
    assert read_review(result, newer) is not None
    again = open_tree("two")
    assert (again[SET_ID], len(read_log(again))) == (newer, 0)
    assert len(read_log(tree)) == 1
    bpy.ops.fruitlangs.show_block()
    assert bpy.context.scene == overview


def test_decisions_on_a_tree_apply_when_it_is_opened_again_after_a_new_count(opened: Path) -> None:
    overview = bpy.context.scene
    tree = open_tree("two")
    reject_one(tree)
    bpy.ops.fruitlangs.show_block()
    newer = count_again(Ledger(opened).folder("two").path)
    assert open_tree("two") == tree
    assert tree[SET_ID] == newer
    bpy.ops.fruitlangs.show_block()
    bpy.ops.fruitlangs.update_block()
    assert trees_of(overview)["two"].reviewed == trees_of(overview)["two"].counted - 1


def test_a_tree_that_failed_cannot_be_opened(opened: Path) -> None:
    block = bpy.context.scene.fruitlangs.block
    block.active = [tree.name for tree in block.trees].index("lost")
    with pytest.raises(RuntimeError, match="not counted"):
        bpy.ops.fruitlangs.open_tree()


def test_a_folder_of_no_block_is_an_error(tmp_path: Path, extension: Any) -> None:
    with pytest.raises(RuntimeError, match="It is not the folder of a block"):
        bpy.ops.fruitlangs.open_block(directory=str(tmp_path))


def test_a_count_whose_source_is_missing_or_has_changed_has_a_note_in_the_list(
    block: Path, tmp_path: Path, extension: Any, capfd: pytest.CaptureFixture[str]
) -> None:
    copy = tmp_path / "block"
    shutil.copytree(block, copy)
    ledger = Ledger(copy)
    one = ledger.trees()[0]
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "0.jpg").touch()
    moved = replace(one, source=photos)
    ledger.write_trees([moved, *ledger.trees()[1:]])
    ledger.write(moved, TreeState(stage="done", fingerprint=moved.fingerprint, inputs=read_inputs(moved)))
    bpy.ops.fruitlangs.open_block(directory=str(copy))
    trees = trees_of(bpy.context.scene)
    assert (trees["one"].note, icon_of(trees["one"])) == ("", "BLANK1")
    assert (icon_of(trees["two"]), icon_of(trees["lost"])) == ("INFO", "ERROR")
    missing = f"its source {block / 'two'} is missing or empty, so its earlier count is kept unchecked"
    assert trees["two"].note == missing
    assert f"Notes on the counts of 3 trees, first two: {missing}" in capfd.readouterr().out
    counted = trees["one"].counted
    (photos / "1.jpg").touch()
    bpy.ops.fruitlangs.update_block()
    tree = trees_of(bpy.context.scene)["one"]
    assert (tree.counted, tree.note) == (counted, "files of its source were added, removed or changed")
    rows = {row["tree"]: row for row in csv.DictReader((copy / "orchard.csv").open())}
    assert (rows["one"]["state"], rows["one"]["reason"], rows["one"]["count"]) == ("outdated", tree.note, str(counted))


def test_many_trees_share_the_points_that_are_shown(block: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from fruitlangs.operators.block import overview

    whole = shown_of(block)
    monkeypatch.setattr(overview, "MOST_POINTS", 400)
    fewer = shown_of(block)
    assert [len(each.points) for each in fewer] == [100, 100, 100, 0]
    assert all(len(each.points) > 100 for each in whole[:3])


def test_trees_with_known_places_stand_there(block: Path, tmp_path: Path) -> None:
    copy = tmp_path / "block"
    shutil.copytree(block, copy)
    ledger = Ledger(copy)
    trees = ledger.trees()
    ledger.write_trees([replace(tree, latitude=47.0, longitude=9.0 + 1e-4 * k) for k, tree in enumerate(trees)])
    places = np.array([each.place for each in shown_of(copy)])
    assert len(np.unique(places.round(6), axis=0)) == len(places)
