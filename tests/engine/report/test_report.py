from __future__ import annotations

import csv
import dataclasses
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fruit_examples import count_of, fruit

from fruitlangs.engine.counting.fruit import AuditEntry, FruitCount, Tree
from fruitlangs.engine.errors import FormatError, OutputError
from fruitlangs.engine.report.meshes import id_color
from fruitlangs.engine.report.results import dump, fruits_document, parse_count
from fruitlangs.engine.report.tables import fruits_csv, size_lines, summary
from fruitlangs.engine.report.words import count_text, explain_nothing_found, headline, location_text
from fruitlangs.engine.result_folder import ResultFolder
from fruitlangs.engine.storage.files import file_hash, write_text


def two_fruit() -> FruitCount:
    return count_of(
        fruit(1, 0.0),
        fruit(2, 1.0),
        points=np.array([[0.0, 0.54, -1.0], [9.0, 9.0, 9.0]]),
        point_colors=np.array([[200, 10, 10], [0, 0, 0]], np.uint8),
        point_fruit_ids=np.array([1, -1]),
    )


def placed() -> FruitCount:
    """Two fruit, one on the first of two trees and one on the ground beyond the row."""
    hanging, lying = two_fruit().fruits
    return dataclasses.replace(
        two_fruit(),
        fruits=[dataclasses.replace(hanging, fallen=False, tree=1), dataclasses.replace(lying, fallen=True)],
        trees=[Tree(1, np.array([0.0, 0.5, -1.0]), 1), Tree(2, np.array([5.0, 0.5, -1.0]), 0)],
    )


NO_FRUIT = FruitCount(
    fruits=[],
    audit=[AuditEntry(0, "dropped", "highest probability .31 is below .50", (0.0, 0.0, 0.0), 0)],
    max_probability=0.31,
    mean_diameter=None,
)


PROVENANCE = {
    "source": "photos",
    "inputs_sha256": "00",
    "encoder": "test",
    "prompts": ["red apple"],
    "training": {"psnr": 21.5, "ssim": None},
}


def write_set(folder: Path, fruit_count: FruitCount) -> None:
    write_text(folder / "fruits.csv", fruits_csv(fruit_count, metres_per_unit=None))
    document = fruits_document(
        fruit_count,
        config={},
        provenance=PROVENANCE,
        files={"fruits.csv": file_hash(folder / "fruits.csv")},
        metres_per_unit=None,
    )
    write_text(folder / "fruits.json", dump(document))


def test_a_count_below_the_most_likely_number_says_why_its_interval_starts_there() -> None:
    counted = dataclasses.replace(two_fruit(), interval=(2, 4), likely=3.2, total=3.9, total_interval=(2, 6))
    assert count_text(counted) == (
        "2 visible fruit counted, most likely 3 (90 % interval 2–4). About 4 with hidden fruit (2–6). "
        "The interval starts at the count because missed fruit are more likely than false ones"
    )
    alike = dataclasses.replace(counted, likely=2.1)
    assert count_text(alike) == "2 visible fruit (90 % interval 2–4). About 4 with hidden fruit (2–6)"


def test_a_known_interval_is_given_also_if_the_number_with_hidden_fruit_is_unknown() -> None:
    counted = dataclasses.replace(two_fruit(), interval=(2, 4))
    assert count_text(counted) == "2 visible fruit (90 % interval 2–4)"
    assert count_text(dataclasses.replace(counted, total_interval=(2, 6))) == count_text(counted)
    assert count_text(dataclasses.replace(counted, total=4.0)) == count_text(counted)
    trees = [dataclasses.replace(tree, interval=(1, 3)) for tree in placed().trees]
    assert "1 on tree 1 (90 % interval 1–3)," in location_text(dataclasses.replace(placed(), trees=trees))[1]
    assert count_text(two_fruit()) == "2 visible fruit"


def test_fruits_json_has_the_names_other_programs_rely_on(tmp_path: Path) -> None:
    write_set(tmp_path, two_fruit())
    document = ResultFolder(tmp_path).read()
    promised = {"schema", "count", "interval", "total", "total_interval", "unit", "metres_per_unit", "fruits"}
    assert promised | {"config", "provenance"} <= set(document)
    assert document["count"] == 2
    assert document["interval"] is document["total"] is document["total_interval"] is None
    assert set(document["fruits"][0]) >= {
        "id",
        "label",
        "center",
        "diameter",
        "axes",
        "probability",
        "visible_fraction",
        "views",
        "color",
        "kind",
    }
    assert document["fruits"][0]["color"] == [180, 40, 30]
    assert document["fruits"][1]["center"] == [1.0, 0.5, -1.0]


def test_fruits_json_counts_hanging_and_fallen_fruit_apart_and_by_tree(tmp_path: Path) -> None:
    write_set(tmp_path, placed())
    document = ResultFolder(tmp_path).read()
    assert (document["count"], document["hanging"], document["fallen"]) == (2, 1, 1)
    assert [(fruit["fallen"], fruit["tree"]) for fruit in document["fruits"]] == [(False, 1), (True, None)]
    first = {"number": 1, "position": [0.0, 0.5, -1.0], "count": 1}
    first |= {"likely": None, "interval": None, "total": None, "total_interval": None, "other_fruit": 0}
    assert document["trees"] == [first, {**first, "number": 2, "position": [5.0, 0.5, -1.0], "count": 0}]


def test_what_is_not_known_of_a_fruits_place_is_empty_in_every_table(tmp_path: Path) -> None:
    write_set(tmp_path, two_fruit())
    document = ResultFolder(tmp_path).read()
    assert (document["hanging"], document["fallen"], document["trees"]) == (None, None, [])
    rows = [
        next(csv.DictReader(io.StringIO(fruits_csv(count, metres_per_unit=None)))) for count in (two_fruit(), placed())
    ]
    assert [(row["fallen"], row["tree"]) for row in rows] == [("", ""), ("false", "1")]


def test_people_read_where_fruit_are() -> None:
    assert location_text(placed()) == ["1 hanging, 1 on the ground", "1 on tree 1, 0 on tree 2, 1 on none of them"]
    assert location_text(two_fruit()) == ["hanging or fallen: unknown, because no ground was found"]
    half = dataclasses.replace(placed(), trees=(), fruits=[placed().fruits[0], two_fruit().fruits[1]])
    assert location_text(half) == ["1 hanging, 0 on the ground, 1 unknown"]


def test_no_fruit_is_a_count_of_zero_that_says_how_near_it_came(tmp_path: Path) -> None:
    write_set(tmp_path, NO_FRUIT)
    document = ResultFolder(tmp_path).read()
    assert document["count"] == 0
    assert document["fruits"] == []
    assert document["audit"]["max_probability"] == 0.31
    assert "0.31" in summary(NO_FRUIT, prompt="pear", threshold=0.5, metres_per_unit=None, seconds={})


def test_a_zero_blames_the_threshold_only_where_nothing_reached_it() -> None:
    clusters = [AuditEntry(number, "dropped", "flat", (1.0, 2.0, 3.0), 40) for number in range(3)]
    dust = AuditEntry(3, "dropped", "9 clusters are too small", (0.0, 0.0, 0.0), 12)
    refused = dataclasses.replace(NO_FRUIT, max_probability=0.9, audit=[*clusters, dust])
    assert explain_nothing_found(NO_FRUIT, 0.5, None).startswith("nothing reached the threshold 0.50")
    assert (
        explain_nothing_found(refused, 0.5, None)
        == "3 clusters reached the threshold 0.50, but none has the shape of a fruit"
    )
    assert explain_nothing_found(dataclasses.replace(refused, audit=[dust]), 0.5, None) == dust.reason


def test_the_table_gives_the_reason_of_a_zero_once() -> None:
    text = summary(NO_FRUIT, prompt="pear", threshold=0.5, metres_per_unit=None, seconds={})
    assert len([line for line in text.splitlines() if "probability" in line]) == 1


def test_the_width_of_the_fruit_in_pixels_is_reported_if_it_is_known() -> None:
    wide = dataclasses.replace(two_fruit(), pixel_width=13.6)
    line = "median width in the photos as read: 14 pixels"
    assert line in size_lines(wide, None)
    assert line in summary(wide, prompt="apple", threshold=0.5, metres_per_unit=None, seconds={})
    assert not any("pixels" in each for each in size_lines(two_fruit(), None))


def test_width_and_notes_come_back_from_fruits_json_and_older_results_have_none() -> None:
    wide = dataclasses.replace(two_fruit(), pixel_width=13.64)
    document = fruits_document(
        wide, config={}, provenance={}, files={}, metres_per_unit=2.0, notices=["a photo is missing"]
    )
    assert (document["pixel_width"], document["notices"]) == (13.6, ["a photo is missing"])
    assert parse_count(document, np.zeros(0, np.int32)).pixel_width == 13.6
    del document["pixel_width"], document["notices"]
    assert parse_count(document, np.zeros(0, np.int32)).pixel_width is None


def test_other_kinds_and_colours_come_back_from_fruits_json_and_older_results_have_none() -> None:
    trees = [dataclasses.replace(tree, other_fruit=tree.number) for tree in placed().trees]
    doubtful = dataclasses.replace(placed(), other_fruit=38, other_colors=7, trees=trees)
    document = fruits_document(doubtful, config={}, provenance={}, files={}, metres_per_unit=None)
    stored = parse_count(document, np.zeros(0, np.int32))
    assert (stored.other_fruit, stored.other_colors) == (38, 7)
    assert [tree.other_fruit for tree in stored.trees] == [1, 2]
    del document["other_fruit"], document["other_colors"]
    for tree in document["trees"]:
        del tree["other_fruit"]
    older = parse_count(document, np.zeros(0, np.int32))
    assert (older.other_fruit, older.other_colors, [tree.other_fruit for tree in older.trees]) == (0, 0, [0, 0])


def test_a_zero_with_an_interval_shows_it_with_its_reason() -> None:
    admits = dataclasses.replace(NO_FRUIT, max_probability=0.9, interval=(0, 7), total=0.0, total_interval=(0, 7))
    text = summary(admits, prompt="apple", threshold=0.5, metres_per_unit=None, seconds={})
    assert text.startswith("apple: 0 visible fruit (90 % interval 0–7)")
    assert NO_FRUIT.audit[0].reason in text
    assert headline(admits, "apple") == "apple: 0 (90 % interval 0–7)"


def test_an_audit_entry_without_a_place_has_no_centre() -> None:
    document = fruits_document(NO_FRUIT, config={}, provenance={}, files={}, metres_per_unit=None)
    assert document["audit"]["clusters"][0]["center"] is None


def test_the_audit_of_a_result_comes_back_in_scene_units_whatever_the_scale() -> None:
    entry = AuditEntry(1, "kept", "one sphere", (0.0, 0.5, -1.0), 40, (1,), diameter=0.08)
    document = fruits_document(
        count_of(fruit(1, 0.0), audit=[entry]), config={}, provenance={}, files={}, metres_per_unit=2.0
    )
    assert document["audit"]["clusters"][0]["diameter"] == 0.16
    assert parse_count(document, np.zeros(0, np.int32)).audit == [entry]


def test_a_file_of_another_run_is_noticed(tmp_path: Path) -> None:
    write_set(tmp_path, two_fruit())
    (tmp_path / "fruits.csv").write_text("id\n")
    with pytest.raises(OutputError, match=r"fruits\.csv"):
        ResultFolder(tmp_path).read()


def test_a_damaged_fruits_json_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "fruits.json").write_text('{"schema": ')
    with pytest.raises(FormatError, match="not a results file"):
        ResultFolder(tmp_path).read()


def without(*keys: str) -> Callable[[Any], None]:
    def change(document: Any) -> None:
        for key in keys[:-1]:
            document = document[key]
        del document[keys[-1]]

    return change


def with_value(key: str, value: object) -> Callable[[Any], None]:
    return lambda document: document.update({key: value})


@pytest.mark.parametrize(
    ("damage", "field"),
    [
        (without("config"), "config"),
        (without("fruits"), "fruits"),
        (without("provenance"), "provenance"),
        (without("provenance", "training"), "training"),
        (without("provenance", "training", "psnr"), "psnr"),
        (with_value("files", []), "files"),
        (with_value("metres_per_unit", "1"), "metres_per_unit"),
        (with_value("fruits", [3]), "fruit"),
        (lambda document: document["fruits"][0].update(center=[1.0, None, 2.0]), "centre of fruit 1"),
    ],
)
def test_a_fruits_json_that_lacks_a_field_names_it(damage: Callable[[Any], None], field: str, tmp_path: Path) -> None:
    write_set(tmp_path, two_fruit())
    document = json.loads((tmp_path / "fruits.json").read_text())
    damage(document)
    (tmp_path / "fruits.json").write_text(json.dumps(document))
    with pytest.raises(FormatError, match=field):
        ResultFolder(tmp_path).read(verify=False)


def test_a_number_that_is_not_finite_is_never_written() -> None:
    with pytest.raises(OutputError, match="finite"):
        dump({"count": float("nan")})


def test_lengths_become_metres_when_the_scale_is_known() -> None:
    document = fruits_document(two_fruit(), config={}, provenance={}, files={}, metres_per_unit=2.0)
    assert document["unit"] == "m"
    assert document["fruits"][0]["diameter"] == pytest.approx(0.16)
    assert document["fruits"][0]["center"] == [0.0, 0.5, -1.0]
    row = next(csv.DictReader(io.StringIO(fruits_csv(two_fruit(), metres_per_unit=2.0))))
    assert float(row["diameter_mm"]) == pytest.approx(160.0)
    lengths = [float(row[f"{name}_mm"]) for name in ("length", "width", "thickness")]
    assert lengths == pytest.approx([320.0, 160.0, 80.0])
    assert np.array(document["fruits"][0]["axes"]) == pytest.approx(2.0 * two_fruit().fruits[0].axes)
    assert float(row["volume_cm3"]) == pytest.approx(two_fruit().fruits[0].volume * 8e6, rel=1e-5)


def test_the_table_has_one_row_a_fruit_and_names_its_unit() -> None:
    rows = list(csv.DictReader(io.StringIO(fruits_csv(two_fruit(), metres_per_unit=None))))
    assert [row["id"] for row in rows] == ["1", "2"]
    assert float(rows[0]["diameter_units"]) == pytest.approx(0.08)


def test_neighbouring_ids_have_distinct_colours() -> None:
    colors = np.array([id_color(number) for number in range(1, 40)], dtype=int)
    assert np.abs(np.diff(colors, axis=0)).sum(axis=1).min() > 100
    assert len({tuple(color) for color in colors.tolist()}) == 39
