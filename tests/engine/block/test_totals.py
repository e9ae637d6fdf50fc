"""Sums of trees, their intervals, and the tables and the page of a block."""

from __future__ import annotations

import csv
import json
import math
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio
import pytest
from PIL import Image

from fruitlangs.engine.block import trees as trees_module
from fruitlangs.engine.block.geopackage import write_geopackage
from fruitlangs.engine.block.ledger import Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry
from fruitlangs.engine.block.page import write_page
from fruitlangs.engine.block.publish import publish_again, publish_block
from fruitlangs.engine.block.reviews import REVIEW, Review, ReviewedFruit, read_review, write_review
from fruitlangs.engine.block.tables import geojson, rows_of, summary, write_tables
from fruitlangs.engine.block.totals import SHARED_ALL, SHARED_VISIBLE, Amount, estimate_all, sum_amounts
from fruitlangs.engine.block.trees import CountedTree, fruit_text, read_counts
from fruitlangs.engine.counting.accounts.review import Decision, Standing, ball
from fruitlangs.engine.errors import ConfigError, OutputError

TREE = Amount(count=10, likely=12.0, low=10.0, high=16.0)


def test_the_shared_part_of_each_variance_adds_up_linearly_and_the_rest_as_independent_errors() -> None:
    whole = sum_amounts([TREE] * 100, ["apple"] * 100, 0.3)
    assert (whole.count, whole.likely) == (1000, 1200.0)
    assert whole.high - whole.likely == pytest.approx(4.0 * math.sqrt(0.7 * 100 + 0.3 * 100**2))
    assert whole.likely - whole.low == pytest.approx(0.5 * (whole.high - whole.likely))


def test_errors_are_shared_within_a_kind_of_fruit_and_independent_between_kinds() -> None:
    together = sum_amounts([TREE] * 4, ["apple", "pear", "apple", "apple"], 1.0)
    assert together.high - together.likely == pytest.approx(4.0 * math.hypot(3, 1))
    assert together.likely - together.low == pytest.approx(2.0 * math.hypot(3, 1))


@pytest.mark.parametrize("shared", [0.0, 0.3, 1.0])
def test_the_interval_of_one_tree_is_its_own(shared: float) -> None:
    assert sum_amounts([TREE], ["apple"], shared) == TREE


def test_all_trees_are_estimated_from_a_sample_with_the_spread_between_trees() -> None:
    alike = estimate_all([TREE] * 10, ["apple"] * 10, 100)
    assert alike.likely == pytest.approx(120.0 * 10)
    different = estimate_all([Amount(count=k, likely=k, low=k, high=k) for k in range(5, 15)], ["apple"] * 10, 100)
    spread = np.std(np.arange(5, 15), ddof=1)
    expected = 100 * spread / math.sqrt(10) * math.sqrt(0.9) * 1.8331  # Student's t of 9 degrees, 95 %
    assert different.likely == pytest.approx(950.0)
    assert different.high - different.likely == pytest.approx(expected, rel=1e-3)


def test_a_sample_of_all_trees_is_their_sum() -> None:
    kinds = ["apple", "apple", "pear", "pear"]
    assert estimate_all([TREE] * 4, kinds, 4) == sum_amounts([TREE] * 4, kinds, SHARED_VISIBLE)


def test_the_interval_for_all_trees_holds_nine_times_in_ten() -> None:
    random = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        block = random.poisson(random.gamma(20.0, 5.0, 60))
        sample = random.choice(block, 12, replace=False)
        found = estimate_all(
            [Amount(count=int(k), likely=float(k), low=float(k), high=float(k)) for k in sample], ["apple"] * 12, 60
        )
        held += found.low <= block.sum() <= found.high
    assert 0.86 < held / 400 < 0.94


@pytest.mark.parametrize(("sample", "trees", "text"), [(5, 4, "more than the 4 of the block"), (2, 9, "or more")])
def test_an_impossible_sample_is_an_error(sample: int, trees: int, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        estimate_all([TREE] * sample, ["apple"] * sample, trees)


@pytest.mark.parametrize("trees", [3, 4, 5])
def test_the_interval_of_all_trees_holds_its_most_likely_number(trees: int) -> None:
    found = estimate_all([Amount(count=10, likely=7.0, low=6.0, high=10.0)] * 3, ["apple"] * 3, trees)
    assert found.low <= found.likely <= found.high


def block(folder: Path) -> list[CountedTree]:
    done, failed = TreeState(stage="done", run="1"), TreeState(stage="failed", run="1", reason="no <photos>")
    trees = []
    for k, row in enumerate("AAB"):
        entry = TreeEntry(
            id=f"t {k}", source=folder, prompt=("apple",), row=row, position=float(k), latitude=47.0, longitude=9.0 + k
        )
        trees.append(
            CountedTree(
                entry=entry,
                state=done,
                counted=10,
                visible=TREE,
                total=Amount(count=10, likely=20.0, low=15.0, high=30.0),
                diameters=(0.07, 0.08),
                volume=0.0004,
                metric=True,
                colors=((190, 30, 40), (60, 140, 40)),
            )
        )
    lost = TreeEntry(id="t 3", source=folder, prompt=("apple",), row="B", position=3.0)
    return [*trees, CountedTree(entry=lost, state=failed)]


def test_the_tables_have_a_line_for_each_tree_and_sums_without_failed_ones(tmp_path: Path) -> None:
    trees = block(tmp_path)
    document = summary(trees, all_trees=30, density=900.0)
    files = write_tables(tmp_path, trees, rows_of(trees, 900.0), document)
    assert [path.name for path in files] == ["orchard.csv", "orchard.json", "orchard.geojson"]
    rows = list(csv.DictReader(files[0].open()))
    assert [row["count"] for row in rows] == ["10", "10", "10", ""]
    assert (rows[0]["yield_kg"], rows[0]["fruit_weight_g"]) == ("0.36", "180.0")
    assert (rows[3]["state"], rows[3]["reason"]) == ("failed", "no <photos>")
    document = json.loads(files[1].read_text())
    assert document["block"]["count"] == 30
    assert document["block"]["with_hidden"] == 60.0
    assert {name: row["count"] for name, row in document["rows"].items()} == {"A": 20, "B": 10}
    assert document["failed"] == {"t 3": "no <photos>"}
    assert document["all_trees"]["likely"] == pytest.approx(360.0)
    assert document["yield_kg"] == pytest.approx(1.08)
    assert document["diameters"]["fruit"] == 6
    assert document["colours"] == {"red": 3, "green": 3}
    assert document["size_classes_mm"] == {"70-75": 3, "80-85": 3}


def test_a_block_of_several_prompts_has_sums_by_prompt_in_place_of_one(tmp_path: Path) -> None:
    one, two, three, lost = block(tmp_path)
    assert "prompts" not in summary([one, two, lost], all_trees=None, density=None)
    pear = replace(three, entry=replace(three.entry, prompt=("pear", "quince")))
    trees = [one, two, pear, replace(lost, entry=replace(lost.entry, prompt=("fig",)))]
    rows, document = rows_of(trees, None), summary(trees, all_trees=None, density=None)
    assert [row["prompt"] for row in rows] == ["apple", "apple", "pear or quince", "fig"]
    assert {name: sums["count"] for name, sums in document["prompts"].items()} == {"apple": 20, "pear or quince": 10}
    assert geojson(trees, rows)["features"][2]["properties"]["prompt"] == "pear or quince"
    page = " ".join(write_page(tmp_path, trees, rows, document).read_text().split())
    assert '<span class="big">20</span> apple, <span class="big">10</span> pear or quince.</p>' in page
    assert '<span class="big">30</span>' not in page
    assert "<td>pear or quince</td><td>1</td><td>10</td> <td>12</td><td>10–16</td> <td>20</td>" in page


def test_a_sum_with_a_tree_that_has_no_interval_has_none_and_says_so(tmp_path: Path) -> None:
    one, two, three, _ = block(tmp_path)
    unknown = replace(two, visible=None, total=None)
    trees = [one, unknown, three]
    rows, document = rows_of(trees, None), summary(trees, all_trees=30, density=None)
    names = ("likely", "low", "high", "with_hidden", "with_hidden_low", "with_hidden_high")
    assert [rows[1][name] for name in ("count", *names)] == [10, *[None] * 6]
    assert [rows[0][name] for name in ("count", *names)] == [10, 12.0, 10.0, 16.0, 20.0, 15.0, 30.0]
    for sums in (document["block"], document["rows"]["A"]):
        assert [sums[name] for name in names] == [None] * 6
        assert sums["without_interval"] == 1
    assert (document["block"]["count"], document["rows"]["A"]["count"]) == (30, 20)
    assert (document["rows"]["B"]["high"], document["rows"]["B"]["without_interval"]) == (16.0, 0)
    assert document["all_trees"] == {"trees": 30, "no_estimate": "1 of 3 counted trees have no interval"}
    page = " ".join(write_page(tmp_path, trees, rows, document).read_text().split())
    assert '<span class="big">30</span> visible fruit counted on 3 of 3 trees.' in page
    assert "1 of 3 trees has no interval, so their sum has none." in page
    assert "A: 1 of 2 trees has no interval, so their sum has none." in page
    assert "<td>A</td><td>2</td><td>20</td> <td></td><td></td> <td></td>" in page
    assert "<td>t 1</td><td>A</td><td>apple</td> <td>10</td><td></td><td></td> <td></td>" in page
    assert "No estimate for all 30 trees. 1 of 3 counted trees have no interval." in page
    assert "With hidden fruit about" not in page
    assert "use the most likely number" not in page


def test_only_what_is_unknown_of_a_sum_is_empty(tmp_path: Path) -> None:
    one, two, _, _ = block(tmp_path)
    sums = summary([one, replace(two, total=None)], all_trees=None, density=None)["block"]
    assert (sums["likely"], sums["with_hidden"], sums["without_interval"]) == (24.0, None, 1)


def test_places_of_trees_without_an_interval_have_empty_properties(tmp_path: Path) -> None:
    one, two, _, _ = block(tmp_path)
    trees = [replace(one, visible=None, total=None), two]
    rows, document = rows_of(trees, None), summary(trees, all_trees=None, density=None)
    files = write_tables(tmp_path, trees, rows, document)
    first = json.loads(files[2].read_text())["features"][0]["properties"]
    assert (first["count"], first["low"], first["with_hidden"]) == (10, None, None)
    with files[0].open() as file:
        assert [line["low"] for line in csv.DictReader(file)] == ["", "10.0"]
    (path,) = write_geopackage(files[2])
    about, _, _, columns = pyogrio.raw.read(path, layer="trees")
    low = dict(zip(about["fields"], columns, strict=True))["low"]
    assert np.isnan(low).tolist() == [True, False]


def test_sums_of_several_kinds_of_fruit_share_errors_within_each_kind_only(tmp_path: Path) -> None:
    one, two, three, _ = block(tmp_path)

    def asked(tree: CountedTree, *prompt: str) -> CountedTree:
        return replace(tree, entry=replace(tree.entry, prompt=prompt))

    def sums(*trees: CountedTree) -> tuple[float, float]:
        found = summary(trees, all_trees=None, density=None)["block"]
        return found["high"] - found["likely"], found["with_hidden_high"] - found["with_hidden"]

    visible, hidden = sums(one, two, three)
    assert visible == pytest.approx(math.sqrt(16.0 * ((1 - SHARED_VISIBLE) * 3 + SHARED_VISIBLE * 9)), abs=0.1)
    assert hidden == pytest.approx(math.sqrt(100.0 * ((1 - SHARED_ALL) * 3 + SHARED_ALL * 9)), abs=0.1)
    of_one_kind = sums(asked(one, "red apple"), asked(two, "Apples", "green apple"), three)
    assert of_one_kind == (visible, hidden)
    visible, _ = sums(asked(one, "pear"), two, three)
    assert visible == pytest.approx(math.sqrt(16.0 * ((1 - SHARED_VISIBLE) * 3 + SHARED_VISIBLE * 5)), abs=0.1)
    visible, _ = sums(asked(one, "pear"), asked(two, "my own word"), three)
    assert visible == pytest.approx(math.sqrt(16.0 * 3), abs=0.1)


def test_rows_sizes_and_all_trees_are_of_one_prompt_each(tmp_path: Path) -> None:
    one, two, three, _ = block(tmp_path)
    pear = replace(three, entry=replace(three.entry, prompt=("pear",), row="A"), diameters=(0.05, 0.06))
    trees = [one, two, pear]
    rows, document = rows_of(trees, 900.0), summary(trees, all_trees=30, density=900.0)
    assert document["rows"]["A"]["count"] == 30
    apples, pears = document["prompts"]["apple"], document["prompts"]["pear"]
    assert [group["rows"]["A"]["count"] for group in (apples, pears)] == [20, 10]
    assert [group["diameters"]["mean"] for group in (apples, pears)] == pytest.approx([0.075, 0.055])
    assert [group["yield_kg"] for group in (apples, pears)] == pytest.approx([0.72, 0.36])
    assert pears["size_classes_mm"] == {"50-55": 1, "60-65": 1}
    # Of three trees drawn at random two bear apples and one bears pears: so do 20 and 10 of 30.
    assert [group["all_trees"]["likely"] for group in (apples, pears)] == pytest.approx([240.0, 120.0])
    page = " ".join(write_page(tmp_path, trees, rows, document).read_text().split())
    assert "<h2>apple</h2>" in page
    assert "Mean diameter 75.0 mm" in page
    assert "Mean diameter 55.0 mm" in page
    assert "Mean diameter 68.3 mm" not in page
    assert page.count("<th>row</th><th>trees</th>") == 2


def test_the_page_says_to_use_the_most_likely_number_if_it_is_above_the_count(tmp_path: Path) -> None:
    def page(likely: float) -> str:
        tree = replace(block(tmp_path)[0], visible=Amount(count=10, likely=likely, low=10.0, high=16.0))
        return write_page(
            tmp_path, [tree], rows_of([tree], None), summary([tree], all_trees=None, density=None)
        ).read_text()

    assert "use the most likely number and its interval" in page(11.0)
    assert "use the most likely number" not in page(10.4)


def test_sizes_are_summed_up_only_in_one_unit(tmp_path: Path) -> None:
    metres, lost = block(tmp_path)[0], block(tmp_path)[3]
    unknown = replace(metres, metric=False, diameters=(1.2, 1.3), folder="other")
    mixed = summary([metres, unknown], all_trees=None, density=900.0)
    assert (mixed["diameters"], mixed["size_classes_mm"], mixed["yield_kg"]) == (None, None, None)
    rows = rows_of([metres, unknown], None)
    page = write_page(tmp_path, [metres, unknown], rows, mixed).read_text()
    assert "Sizes are not summed up, because the scale of some trees is unknown." in page
    assert "75.0 mm" in page
    assert "1.25 scene units" in page
    two = summary([unknown, replace(unknown, folder="third")], all_trees=None, density=None)
    assert two["diameters"] is None
    one = summary([unknown, lost], all_trees=None, density=None)
    assert one["diameters"]["mean"] == pytest.approx(1.25)


def test_too_few_trees_for_an_estimate_have_tables_that_say_so(tmp_path: Path) -> None:
    trees = block(tmp_path)[2:]
    document = summary(trees, all_trees=40, density=None)
    rows = rows_of(trees, None)
    assert document["block"]["count"] == 10
    assert document["all_trees"]["no_estimate"].endswith("3 counted ones or more, and here are 1")
    page = write_page(tmp_path, trees, rows, document).read_text()
    assert "No estimate for all 40 trees. All trees are estimated from 3 counted ones or more, and here are 1." in page


def test_a_map_has_the_trees_with_places_longitude_first(tmp_path: Path) -> None:
    trees = block(tmp_path)
    features = geojson(trees, rows_of(trees, None))["features"]
    assert [each["geometry"]["coordinates"] for each in features] == [[9.0, 47.0], [10.0, 47.0], [11.0, 47.0]]
    assert features[0]["properties"]["count"] == 10


def test_a_geopackage_has_the_same_places_and_columns_as_the_map(tmp_path: Path) -> None:
    trees = block(tmp_path)
    files = write_tables(tmp_path, trees, rows_of(trees, None), summary(trees, all_trees=None, density=None))
    (path,) = write_geopackage(files[2])
    about, _, points, columns = pyogrio.raw.read(path, layer="trees")
    assert about["crs"] == "EPSG:4326"
    assert [np.frombuffer(point[5:], "<f8").tolist() for point in points] == [[9.0, 47.0], [10.0, 47.0], [11.0, 47.0]]
    values = dict(zip(about["fields"], columns, strict=True))
    assert set(values) == set(geojson(trees, rows_of(trees, None))["features"][0]["properties"])
    assert (values["tree"].tolist(), values["count"].tolist()) == (["t 0", "t 1", "t 2"], [10, 10, 10])


def test_no_geopackage_is_left_without_places_or_without_its_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trees = block(tmp_path)
    places = write_tables(tmp_path, trees, rows_of(trees, None), summary(trees, all_trees=None, density=None))[2]
    (path,) = write_geopackage(places)
    monkeypatch.setitem(sys.modules, "pyogrio", None)
    assert write_geopackage(places) == []
    assert not path.exists()
    monkeypatch.undo()
    (path,) = write_geopackage(places)
    nowhere = trees[3:]
    write_tables(tmp_path, nowhere, rows_of(nowhere, None), summary(nowhere, all_trees=None, density=None))
    assert write_geopackage(places) == []
    assert not path.exists()


def test_a_geopackage_of_a_damaged_map_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "orchard.geojson").write_text("{")
    with pytest.raises(OutputError, match=r"orchard\.gpkg cannot be written"):
        write_geopackage(tmp_path / "orchard.geojson")


def test_weights_need_metres(tmp_path: Path) -> None:
    tree = block(tmp_path)[0]
    unknown = CountedTree(entry=tree.entry, state=tree.state, counted=10, visible=TREE, volume=3.0)
    assert rows_of([unknown], 900.0)[0]["yield_kg"] is None


def test_the_page_says_what_failed_and_escapes_it(tmp_path: Path) -> None:
    trees = block(tmp_path)
    page = write_page(tmp_path, trees, rows_of(trees, None), summary(trees, all_trees=None, density=None)).read_text()
    assert "1 tree failed and is not in the sums." in page
    assert "no &lt;photos&gt;" in page
    assert "<photos>" not in page
    assert page.count("<circle") == 4
    assert "75.0 mm" in page


def test_a_block_in_which_nothing_is_counted_has_a_page(tmp_path: Path) -> None:
    lost = block(tmp_path)[3:]
    rows, document = rows_of(lost, None), summary(lost, all_trees=None, density=None)
    write_tables(tmp_path, lost, rows, document)
    page = write_page(tmp_path, lost, rows, document).read_text()
    assert "No tree was counted." in page
    assert "visible fruit" not in page


def test_a_tree_without_a_place_has_that_of_its_photos(tmp_path: Path) -> None:
    photos = tmp_path / "photos" / "images"
    photos.mkdir(parents=True)
    for k in range(3):
        exif = Image.Exif()
        exif.get_ifd(0x8825).update({1: "N", 2: (47.0, 0.0, 0.0), 3: "E", 4: (9.0, 6.0 * k, 0.0)})
        Image.new("RGB", (8, 8)).save(photos / f"{k}.jpg", exif=exif)
    ledger = Ledger(tmp_path / "block")
    tree = TreeEntry(id="1", source=tmp_path / "photos", prompt=("apple",))
    given = TreeEntry(id="2", source=tmp_path / "photos", prompt=("apple",), latitude=1.0, longitude=2.0)
    ledger.write_trees([tree, given])
    one, other = (each.entry for each in read_counts(ledger))
    assert (one.latitude, one.longitude) == pytest.approx((47.0, 9.1))
    assert (other.latitude, other.longitude) == (1.0, 2.0)


def test_at_most_so_many_photos_are_asked_for_their_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    photos = tmp_path / "photos" / "images"
    photos.mkdir(parents=True)
    for k in range(199):
        (photos / f"{k:03}.jpg").touch()
    asked: list[Path] = []
    monkeypatch.setattr(trees_module, "read_gps", asked.append)
    trees_module._tags(TreeEntry(id="1", source=tmp_path / "photos", prompt=("apple",)), 100)
    assert 50 <= len(asked) <= 100


def row_result(ledger: Ledger, entry: TreeEntry) -> None:
    """A result with two trees 4 m apart, with two fruit and one, and one fruit of no tree."""
    fruits = [
        {"id": number, "label": "apple", "center": [0, 0, 0], "diameter": size, "volume": 1e-4, "color": [190, 30, 40]}
        | {"tree": tree, "probability": 0.9, "axes": [[0.04, 0, 0], [0, 0.04, 0], [0, 0, 0.04]]}
        for number, (tree, size) in enumerate([(1, 0.07), (1, 0.08), (2, 0.06), (None, 0.07)], start=1)
    ]
    common = {"interval": [1, 3], "total": 4.0, "total_interval": [2, 6]}
    trees = [
        {"number": 1, "position": [0, 0, 0], "count": 2, "likely": 2.2, **common},
        {"number": 2, "position": [0, 8, 0], "count": 1, "likely": 1.1, **common},
    ]
    document = {
        "schema": "fruitlangs.fruits/1",
        "set_id": "1",
        "count": 4,
        "unit": "m",
        "metres_per_unit": 0.5,
        "fruits": fruits,
        "trees": trees,
        "config": {},
        "files": {},
        "provenance": {
            "source": "row",
            "inputs_sha256": "0",
            "encoder": "e",
            "training": {"psnr": None, "ssim": None},
            "prompts": ["apple"],
        },
    }
    folder = ledger.result(entry).path
    folder.mkdir(parents=True)
    (folder / "fruits.json").write_text(json.dumps(document))
    ledger.write(entry, TreeState(stage="done", fingerprint=entry.fingerprint, run="1", seconds=3.0))


def test_a_row_has_a_line_for_each_of_its_trees(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",), position=10.0)
    lone = TreeEntry(id="lone", source=tmp_path / "lone", prompt=("apple",))
    ledger.write_trees([row, lone])
    row_result(ledger, row)
    one, two, waiting = read_counts(ledger)
    assert [(tree.entry.id, tree.entry.row, tree.entry.position) for tree in (one, two)] == [
        ("west-1", "west", 10.0),
        ("west-2", "west", 14.0),
    ]
    assert one.visible == Amount(count=2, likely=2.2, low=1, high=3)
    assert (one.diameters, two.diameters) == ((0.07, 0.08), (0.06,))
    assert (waiting.entry.id, waiting.visible) == ("lone", None)
    document = summary([one, two, waiting], all_trees=None, density=None)
    assert (document["trees"], document["done"], document["elsewhere"]) == (3, 2, 1)
    assert document["rows"]["west"]["count"] == 3
    files = write_tables(ledger.path, [one, two, waiting], rows_of([one, two, waiting], None), document)
    assert [tree["result"] for tree in json.loads(files[1].read_text())["by_tree"]] == ["trees/west"] * 2 + [
        "trees/lone"
    ]
    page = write_page(ledger.path, [one, two], rows_of([one, two], None), document).read_text()
    assert "1 counted fruit belong to no tree of their row and are not in the sums." in page
    assert page.count("<circle") == 2


def test_the_count_of_a_result_in_words_names_the_trees_of_a_row(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",))
    ledger.write_trees([row])
    row_result(ledger, row)
    path = ledger.result(row).path / "fruits.json"
    assert fruit_text(path.parent) == "4 fruit on 2 trees"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"trees": []}))
    assert fruit_text(path.parent) == "4 fruit"
    path.write_text("{")
    assert "is not a results file" in fruit_text(path.parent)


def test_a_0_where_fruit_of_other_kinds_are_is_no_quiet_0_of_a_block(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row, lone = (TreeEntry(id=own, source=tmp_path / own, prompt=("plum",)) for own in ("west", "lone"))
    ledger.write_trees([row, lone])
    for each in (row, lone):
        row_result(ledger, each)
    path = ledger.result(row).path / "fruits.json"
    document = json.loads(path.read_text())
    document["trees"][1] |= {"count": 0, "interval": [0, 54], "total_interval": [0, 66], "other_fruit": 38}
    path.write_text(json.dumps(document))
    path = ledger.result(lone).path / "fruits.json"
    document = json.loads(path.read_text()) | {"trees": [], "fruits": [], "count": 0, "other_fruit": 25}
    path.write_text(json.dumps(document | {"interval": [0, 30], "total": 0.0, "total_interval": [0, 40]}))
    assert fruit_text(path.parent) == "0 fruit, 25 of other kinds"
    trees = read_counts(ledger)
    assert [re.findall(r"only 0 fruit were counted, and (\d+) that look", tree.note) for tree in trees] == [
        [], ["38"], ["25"]
    ]  # fmt: skip
    answer = summary(trees, all_trees=None, density=None)
    assert set(answer["notes"]) == {"west", "lone"}
    assert answer["block"]["high"] > 54
    assert ["look like other kinds" in line["reason"] for line in rows_of(trees, None)] == [False, True, True]
    write_review(path.parent, "another set", Review(fruits=[]))
    _, _, lone_tree = read_counts(ledger)
    assert "its review is of an earlier count" in lone_tree.note
    assert "25 that look like other kinds" in lone_tree.note


@pytest.mark.parametrize(
    ("changed", "visible", "total"),
    [
        ({"interval": None}, None, Amount(count=2, likely=4.0, low=2, high=6)),
        ({"likely": None}, None, Amount(count=2, likely=4.0, low=2, high=6)),
        ({"total": None}, Amount(count=2, likely=2.2, low=1, high=3), None),
        ({"total_interval": None}, Amount(count=2, likely=2.2, low=1, high=3), None),
        (
            {"count": 0, "likely": None, "interval": [0, 7], "total": 0.0, "total_interval": [0, 9]},
            Amount(count=0, likely=0.0, low=0, high=7),
            Amount(count=0, likely=0.0, low=0, high=9),
        ),
    ],
    ids=["interval", "most likely", "total", "total interval", "a zero"],
)
def test_what_a_result_does_not_know_stays_unknown(
    changed: dict[str, Any], visible: Amount | None, total: Amount | None, tmp_path: Path
) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",))
    ledger.write_trees([row])
    row_result(ledger, row)
    path = ledger.result(row).path / "fruits.json"
    document = json.loads(path.read_text())
    document |= {"likely": 9.0, "interval": [8, 10], "total": 9.0, "total_interval": [8, 10]}  # of the whole row
    document["trees"][0] |= changed
    path.write_text(json.dumps(document))
    one, two = read_counts(ledger)
    assert (one.count, one.visible, one.total) == (changed.get("count", 2), visible, total)
    assert two.visible == Amount(count=1, likely=1.1, low=1, high=3)
    write_review(path.parent, "1", Review(fruits=[reviewed(1, "confirmed")]))
    one, _ = read_counts(ledger)
    assert one.count == 1
    assert (one.visible is None, one.total is None) == (visible is None, visible is None or total is None)


def test_a_tree_of_a_row_whose_entry_lacks_an_interval_has_not_that_of_the_row(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",))
    ledger.write_trees([row])
    row_result(ledger, row)
    path = ledger.result(row).path / "fruits.json"
    document = json.loads(path.read_text()) | {"likely": 9.0, "interval": [8, 10]}
    del document["trees"][0]["likely"]
    path.write_text(json.dumps(document))
    assert [tree.visible is None for tree in read_counts(ledger)] == [True, False]


def test_a_count_that_is_outdated_or_whose_source_is_missing_says_so_in_tables_and_page(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    gone, old = (TreeEntry(id=own, source=tmp_path / own, prompt=("apple",)) for own in ("gone", "old"))
    ledger.write_trees([gone, old])
    for each in (gone, old):
        row_result(ledger, each)
    old.source.mkdir()
    Image.new("RGB", (8, 8)).save(old.source / "0.jpg")
    answer = publish_block(ledger)
    missing, outdated = f"its source {gone.source} is missing or empty", "an earlier version counted it"
    rows = rows_of(answer.trees, None)
    assert [row["state"] for row in rows] == ["done", "done", "outdated", "outdated"]
    assert [row["count"] for row in rows] == [2, 1, 2, 1]
    assert all(row["reason"].startswith(missing) for row in rows[:2])
    assert all(row["reason"].startswith(outdated) for row in rows[2:])
    notes = answer.document["notes"]
    assert list(notes) == ["gone", "old"]
    assert notes["gone"].startswith(missing)
    assert answer.document["block"]["count"] == 6
    page = " ".join((ledger.path / "orchard.html").read_text().split())
    assert "Notes on counts that are in the sums" in page
    assert f"<li>gone: {missing}" in page
    assert f"<li>old: {outdated}" in page


def test_the_map_does_not_say_0_of_a_tree_that_waits(tmp_path: Path) -> None:
    trees = block(tmp_path)[:2]
    trees[1] = CountedTree(entry=trees[1].entry, state=TreeState())
    page = write_page(tmp_path, trees, rows_of(trees, None), summary(trees, all_trees=None, density=None)).read_text()
    assert "<title>t 0: 10 fruit</title>" in page
    assert "<title>t 1: not counted yet</title>" in page


def test_trees_of_a_row_without_gps_tags_have_the_place_of_their_line(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",), latitude=47.5, longitude=9.5)
    ledger.write_trees([row])
    row_result(ledger, row)
    assert [(tree.entry.latitude, tree.entry.longitude) for tree in read_counts(ledger)] == [(47.5, 9.5)] * 2


@pytest.mark.parametrize(
    "damage",
    [
        lambda document: document["fruits"][0].pop("tree"),
        lambda document: document["fruits"][0].update(color=[1, 2]),
        lambda document: document["fruits"][0].update(diameter=math.inf),
        lambda document: document["trees"][0].pop("number"),
        lambda document: document["trees"][0].update(position=[math.nan, 0, 0]),
        lambda document: document["trees"][1].update(count=-1),
        lambda document: document.update(trees=3),
        lambda document: document.pop("unit"),
    ],
)
def test_a_damaged_result_is_a_failed_tree_and_the_others_are_summed(
    damage: Callable[[Any], object], tmp_path: Path
) -> None:
    ledger = Ledger(tmp_path / "block")
    row, other = (TreeEntry(id=own, source=tmp_path / own, prompt=("apple",)) for own in ("west", "east"))
    ledger.write_trees([row, other])
    for each in (row, other):
        row_result(ledger, each)
    path = ledger.result(row).path / "fruits.json"
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))
    document = publish_block(ledger).document
    assert (document["done"], document["block"]["count"]) == (2, 3)  # the trees of the other row
    assert list(document["failed"]) == ["west"]
    assert re.search(r"west.fruits\.json is damaged.*Delete it and count again", document["failed"]["west"])


@pytest.mark.parametrize("text", ["[1]", '{"all_trees": 3}', '{"all_trees": {"trees": "x"}, "density": NaN}', "{"])
def test_a_damaged_table_is_written_again(text: str, tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",))
    ledger.write_trees([row])
    row_result(ledger, row)
    whole = publish_block(ledger).files[1].read_text()
    (ledger.path / "orchard.json").write_text(text)
    assert publish_again(ledger).files[1].read_text() == whole


def reviewed(tree: int | None, standing: Standing, probability: float = 0.6) -> ReviewedFruit:
    return ReviewedFruit(
        tree=tree,
        standing=standing,
        probability=probability,
        center=(0.0, 7.0, 0.0),
        axes=((0.05, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 0.05)),
        diameter=0.1,
        volume=5e-4,
        color=(60, 140, 40),
    )


def test_the_tables_use_the_review_of_a_tree_and_keep_what_was_counted(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",))
    ledger.write_trees([row])
    row_result(ledger, row)
    decided = [reviewed(1, "rejected"), reviewed(1, ""), reviewed(2, "confirmed"), reviewed(None, "added")]
    write_review(ledger.result(row).path, "1", Review(fruits=decided))
    one, two = read_counts(ledger)
    assert [(tree.counted, tree.reviewed, tree.count) for tree in (one, two)] == [(2, 1, 1), (1, 2, 2)]
    assert one.diameters == (0.1,)
    assert two.colors == ((60, 140, 40),) * 2
    assert two.visible is not None
    assert two.visible.low == 2  # confirmed, and added by the user
    lines = rows_of([one, two], None)
    assert [(line["count"], line["reviewed"]) for line in lines] == [(2, 1), (1, 2)]
    assert summary([one, two], all_trees=None, density=None)["block"]["count"] == 3
    page = write_page(ledger.path, [one, two], lines, summary([one, two], all_trees=None, density=None)).read_text()
    assert "<th>reviewed</th>" in page
    assert "<td>2</td><td>1</td>" in page
    assert two.total is not None
    assert (two.total.likely, two.total.count) == (5.0, 2)


def test_a_review_of_an_earlier_count_is_not_used_and_a_damaged_one_is_a_failure(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path / "block")
    row = TreeEntry(id="west", source=tmp_path / "row", prompt=("apple",))
    ledger.write_trees([row])
    row_result(ledger, row)
    folder = ledger.result(row).path
    write_review(folder, "another set", Review(fruits=[reviewed(1, "rejected")]))
    trees = read_counts(ledger)
    assert [tree.reviewed for tree in trees] == [None, None]
    assert all("its review is of an earlier count and is not used" in tree.note for tree in trees)
    (folder / REVIEW).write_text('{"set_id": "1", "fruits": [{"tree": 1}]}')
    (failed,) = read_counts(ledger)
    assert failed.count is None
    assert "review.json is damaged" in failed.state.reason


def test_the_decisions_of_a_review_can_be_read_again(tmp_path: Path) -> None:
    spot = ball(7, "apple", np.array([1.0, 2.0, 3.0]), 0.08)
    decision = Decision("add", "2026-11-28T10:00:00Z", "half hidden", (), (spot,))
    write_review(tmp_path, "1", Review(fruits=[reviewed(1, "added")], decisions=[decision]))
    review = read_review(tmp_path, "1")
    assert review is not None
    (read,) = review.decisions
    assert (read.action, read.reason, read.before, read.after[0].id) == ("add", "half hidden", (), 7)
    np.testing.assert_array_equal(read.after[0].axes, spot.axes)
    assert review.fruits == [reviewed(1, "added")]
