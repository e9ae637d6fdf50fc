"""Sums of trees, their intervals, and the tables and the page of a block."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fruitlangs.engine.block.ledger import Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry
from fruitlangs.engine.block.page import write_page
from fruitlangs.engine.block.tables import geojson, rows_of, summary, write_tables
from fruitlangs.engine.block.totals import SHARED, Amount, CountedTree, of_all, read_counts, summed
from fruitlangs.engine.errors import ConfigError

TREE = Amount(count=10, likely=12.0, low=10.0, high=16.0)


def test_half_of_each_variance_adds_up_linearly_and_the_rest_as_independent_errors() -> None:
    whole = summed([TREE] * 100)
    assert (whole.count, whole.likely) == (1000, 1200.0)
    assert whole.high - whole.likely == pytest.approx(4.0 * math.sqrt((1 - SHARED) * 100 + SHARED * 100**2))
    assert whole.likely - whole.low == pytest.approx(0.5 * (whole.high - whole.likely))


def test_the_interval_of_one_tree_is_its_own() -> None:
    assert summed([TREE]) == TREE


def test_all_trees_are_estimated_from_a_sample_with_the_spread_between_trees() -> None:
    alike = of_all([TREE] * 10, 100)
    assert alike.likely == pytest.approx(120.0 * 10)
    different = of_all([Amount(count=k, likely=k, low=k, high=k) for k in range(5, 15)], 100)
    spread = np.std(np.arange(5, 15), ddof=1)
    expected = 100 * spread / math.sqrt(10) * math.sqrt(0.9) * 1.8331  # Student's t of 9 degrees, 95 %
    assert different.likely == pytest.approx(950.0)
    assert different.high - different.likely == pytest.approx(expected, rel=1e-3)


def test_a_sample_of_all_trees_is_their_sum() -> None:
    assert of_all([TREE] * 4, 4) == summed([TREE] * 4)


def test_the_interval_for_all_trees_holds_nine_times_in_ten() -> None:
    random = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        block = random.poisson(random.gamma(20.0, 5.0, 60))
        sample = random.choice(block, 12, replace=False)
        found = of_all([Amount(count=int(k), likely=float(k), low=float(k), high=float(k)) for k in sample], 60)
        held += found.low <= block.sum() <= found.high
    assert 0.86 < held / 400 < 0.94


@pytest.mark.parametrize(("sample", "trees", "text"), [(5, 4, "more than the 4 of the block"), (2, 9, "or more")])
def test_an_impossible_sample_is_an_error(sample: int, trees: int, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        of_all([TREE] * sample, trees)


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
    assert rows[0]["kg"] == "0.36"
    assert (rows[3]["state"], rows[3]["reason"]) == ("failed", "no <photos>")
    document = json.loads(files[1].read_text())
    assert document["block"]["count"] == 30
    assert document["block"]["with_hidden"] == 60.0
    assert {name: row["count"] for name, row in document["rows"].items()} == {"A": 20, "B": 10}
    assert document["failed"] == {"t 3": "no <photos>"}
    assert document["all_trees"]["likely"] == pytest.approx(360.0)
    assert document["kg"] == pytest.approx(1.08)
    assert document["diameters"]["fruit"] == 6
    assert document["colours"] == {"red": 3, "green": 3}


def test_a_map_has_the_trees_with_places_longitude_first(tmp_path: Path) -> None:
    trees = block(tmp_path)
    features = geojson(trees, rows_of(trees, None))["features"]
    assert [each["geometry"]["coordinates"] for each in features] == [[9.0, 47.0], [10.0, 47.0], [11.0, 47.0]]
    assert features[0]["properties"]["count"] == 10


def test_weights_need_metres(tmp_path: Path) -> None:
    tree = block(tmp_path)[0]
    unknown = CountedTree(entry=tree.entry, state=tree.state, visible=TREE, volume=3.0)
    assert rows_of([unknown], 900.0)[0]["kg"] is None


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
    assert ">0</span> visible fruit counted on 0 of 1 trees" in page


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
