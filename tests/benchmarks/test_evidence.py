"""The records of measurements, and the tables of the documents made from them."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from measurements import RESULT

from fruitlangs.benchmarks.evidence import code_state
from fruitlangs.benchmarks.evidence.documents import DOCUMENTS, FOR_USERS, draw_conditions, fill
from fruitlangs.benchmarks.evidence.records import (
    Record,
    Trial,
    merge_records,
    read_records,
    record_of,
    write_records,
)
from fruitlangs.benchmarks.evidence.studies import CONDITIONS, STUDIES, training_of
from fruitlangs.benchmarks.evidence.tables import TABLES, share_interval
from fruitlangs.benchmarks.ladder.ladder import StageResult
from fruitlangs.benchmarks.ladder.rows import cells_of, row_of
from fruitlangs.benchmarks.ladder.stages import END_TO_END, STAGES, TRUE_POSES
from fruitlangs.benchmarks.orchards import PRESETS
from fruitlangs.engine.errors import FormatError
from fruitlangs.engine.evaluation.camera_errors import CameraErrors
from fruitlangs.engine.evaluation.metrics import VisibilityClass

ROOT = Path(__file__).resolve().parents[2]


def changed(record: Record, **cells: str) -> Record:
    return Record({**record.cells, **cells})


def test_the_committed_documents_say_what_the_committed_records_hold() -> None:
    records = read_records()
    assert records
    for name in DOCUMENTS:
        text = (ROOT / name).read_text(encoding="utf-8")
        assert fill(text, records, for_users=name in FOR_USERS) == text, f"{name} is out of date: run make stale"


def test_tables_for_users_have_the_day_and_neither_commit_nor_machine() -> None:
    record = record_of(replace(RESULT, scene="plum-whole-413", stage=END_TO_END), "voting")
    text = fill("<!-- table whole -->\n<!-- end -->", [record], for_users=True)
    assert f"Measured {record.cells['date']}.\n" in text
    assert record.cells["commit"] not in text
    assert record.cells["machine"] not in text
    old = fill("<!-- table whole -->\n<!-- end -->", [changed(record, code="0" * 12)], for_users=True)
    assert f"Measured {record.cells['date']} with an earlier version.\n" in old


def test_every_block_of_a_document_has_a_table_and_every_study_a_block() -> None:
    blocks = {
        block
        for name in DOCUMENTS
        for block in re.findall(r"<!-- table ([a-z-]+) -->", (ROOT / name).read_text(encoding="utf-8"))
    }
    assert blocks <= set(TABLES)
    assert set(STUDIES) - blocks <= {"known-cameras"}


def test_every_scene_of_a_study_is_a_preset() -> None:
    for study in STUDIES.values():
        for scene in study.scenes:
            assert (PRESETS / f"{scene.partition(':')[0]}.toml").is_file(), scene
        assert set(study.stages) <= set(STAGES)


def test_every_preset_of_one_condition_is_measured_but_the_row() -> None:
    presets = {path.stem.removeprefix("apple-small").removeprefix("-") for path in PRESETS.glob("apple-small*.toml")}
    assert presets - set(CONDITIONS) == {"row", "sparse-leaves"}


def test_a_line_holds_all_that_the_tables_need() -> None:
    cameras = CameraErrors(placed=58, photos=60, center=0.0021, center_90=0.0053, rotation=0.08, rotation_90=0.14)
    classes = [
        VisibilityClass(low=0.5, high=0.75, visible=8, recall=0.75, center_error=float("nan"), diameter_error=0.1)
    ]
    given = replace(RESULT, cameras=cameras, classes=classes)
    read = row_of(cells_of(given))
    assert replace(read, classes=(), ece=0.02) == replace(given, classes=())
    assert [(each.low, each.high, each.visible, each.recall) for each in read.classes] == [(0.5, 0.75, 8, 0.75)]


def test_a_failed_stage_is_read_as_failed_and_has_no_count() -> None:
    failed = StageResult(species="apple", seed=102, scene="s", stage=END_TO_END, counted=None, failed="no cameras")
    read = row_of(cells_of(failed))
    assert (read.counted, read.near, read.failed) == (None, None, "no cameras")


def test_records_are_kept_in_a_file_and_later_ones_replace_earlier_ones(tmp_path: Path) -> None:
    first = record_of(RESULT, "voting")
    other = record_of(RESULT, "template")
    again = record_of(replace(RESULT, counted=91), "voting")
    write_records(merge_records([first, other], [again]), tmp_path / "results.csv")
    read = read_records(tmp_path / "results.csv")
    assert [(each.trial.method, each.result.counted) for each in read] == [("template", 90), ("voting", 91)]


def test_a_file_without_a_column_is_refused(tmp_path: Path) -> None:
    (tmp_path / "results.csv").write_text("species,seed\napple,1\n")
    with pytest.raises(FormatError, match="lacks the columns"):
        read_records(tmp_path / "results.csv")


def test_a_row_of_other_code_is_stale_and_the_head_of_its_table_says_so() -> None:
    fresh = record_of(RESULT, "voting")
    old = changed(record_of(replace(RESULT, scene="plum-small-102", species="plum"), "voting"), code="0123")
    assert not fresh.stale
    assert old.stale
    text = fill("<!-- table known-cameras -->\nold\n<!-- end -->", [old])
    assert "**Stale**: measured with earlier code." in text
    assert "15 of 16 rows are not measured yet" in text
    assert "| plum | 100, 90 | 0.904 |  |  |" in text
    assert "\nold\n" not in text


def test_a_table_of_current_rows_leaves_out_stale_ones() -> None:
    fresh = record_of(RESULT, "voting")
    old = changed(record_of(replace(RESULT, scene="plum-small-102", species="plum"), "voting"), code="0123")
    text = fill("<!-- table known-cameras -->\n\n<!-- end -->", [fresh, old])
    assert "Stale" not in text
    assert "15 of 16 rows are not measured yet" in text
    assert "| apple | 100, 90 | 0.904 |  |  |" in text
    assert "| plum |  |  |  |  |" in text


def test_code_is_the_same_with_other_comments_and_docstrings_and_differs_with_another_sign(tmp_path: Path) -> None:
    texts = [
        '"""A."""\nx = 1\ndef f():\n    """B."""\n    return +x\n',
        'x = 1  # one\n\ndef f():\n    """C."""\n    return +x\n',
        'x = 1\ndef f():\n    return -x\n',
    ]  # fmt: skip
    meanings = []
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.py").write_text(text)
        meanings.append(code_state._meaning(tmp_path / f"{number}.py"))
    assert meanings[0] == meanings[1]
    assert meanings[0] != meanings[2]


def test_only_counts_from_photos_alone_depend_on_the_camera_search(monkeypatch: pytest.MonkeyPatch) -> None:
    def hashes() -> list[str]:
        code_state.code_hash.cache_clear()
        return [code_state.code_hash("apple-small", known_cameras, True) for known_cameras in (True, False)]

    before, files = hashes(), code_state._files()
    searched = next(name for name in files if name.startswith(code_state.CAMERA_SEARCH))
    monkeypatch.setattr(code_state, "_files", lambda: {**files, searched: "another meaning"})
    assert [old == new for old, new in zip(before, hashes(), strict=True)] == [True, False]
    monkeypatch.setattr(code_state, "_files", lambda: {**files, "engine/pipeline.py": "another meaning"})
    assert not set(before) & set(hashes())
    code_state.code_hash.cache_clear()


def test_only_counts_that_search_photos_depend_on_that_search(monkeypatch: pytest.MonkeyPatch) -> None:
    trials = [
        Trial(scene="apple-small-101", stage=stage, method=method)
        for stage, method in (
            ("counting-only", "voting"), ("true-geometry", "voting"), ("true-masks", "voting"), (TRUE_POSES, "voting"),
            (TRUE_POSES, "template"), (TRUE_POSES, "fruitnerf"), (TRUE_POSES, "two-photos"),
        )
    ]  # fmt: skip
    before, files = [trial.code for trial in trials], code_state._files()
    searched = next(name for name in files if name.startswith(code_state.PHOTO_SEARCH))
    monkeypatch.setattr(code_state, "_files", lambda: {**files, searched: "another meaning"})
    code_state.code_hash.cache_clear()
    changed_codes = [old != trial.code for old, trial in zip(before, trials, strict=True)]
    assert changed_codes == [False, False, True, True, False, False, False]
    code_state.code_hash.cache_clear()


def test_a_row_depends_on_the_preset_of_its_scene() -> None:
    presets = ("apple-small", "plum-small", "apple-small-wind")
    assert len({Trial(scene=f"{preset}-101", stage=TRUE_POSES).code for preset in presets}) == 3


def test_only_what_is_missing_or_stale_is_measured() -> None:
    from make_tables import open_trials

    trials = STUDIES["known-cameras"].trials
    records = [record_of(replace(RESULT, scene=trial.scene), "voting") for trial in trials[:-1]]
    records[0] = changed(records[0], code="0123")
    opened = open_trials(["known-cameras"], records)
    assert opened == {"apple-small:102": [trials[0]], "orange-small:103": [trials[-1]]}
    assert trials[0] == Trial(scene="apple-small-102", stage=TRUE_POSES)


def test_an_interval_that_misses_is_not_counted_as_held() -> None:
    held = record_of(RESULT, "voting")
    missed = record_of(replace(RESULT, scene="apple-small-103", seed=103, interval=(101, 110)), "voting")
    table = TABLES["intervals"]([held, missed])
    assert "| apple | 2 | 2 | 1 of 2 | 0.110 | 2 of 2 | 0.250 |" in table


def test_counts_of_one_tree_in_several_conditions_are_one_tree_behind_a_coverage() -> None:
    scenes = [("apple-small-102", TRUE_POSES), ("apple-small-wind-102", TRUE_POSES), ("apple-small-102", END_TO_END)]
    held = [record_of(replace(RESULT, scene=scene, stage=stage), "voting") for scene, stage in scenes]
    pear = record_of(replace(RESULT, species="pear", scene="pear-small-102"), "voting")
    table = TABLES["intervals"]([*held, pear])
    assert "| apple | 3 | 1 | 3 of 3 | 0.130 |" in table
    assert "| all | 4 | 2 | 4 of 4 | 0.130 |" in table


def test_a_coverage_of_ten_trees_has_an_interval_in_which_a_tree_counts_once() -> None:
    held = [
        record_of(replace(RESULT, scene=f"{preset}-{seed}", seed=seed), "voting")
        for seed in range(102, 112)
        for preset in ("apple-small", "apple-small-wind")
    ]
    assert "| all | 20 | 10 | 20 of 20 (72–100 %) |" in TABLES["intervals"](held)
    assert "| all | 18 | 9 | 18 of 18 | 0.130 |" in TABLES["intervals"](held[2:])


def test_a_share_of_few_trees_is_uncertain_as_wilson_has_it() -> None:
    assert share_interval([1.0, 1.0, 1.0, 0.0]) == pytest.approx((0.3006, 0.9544), abs=1e-4)
    assert share_interval([0.5] * 4) == pytest.approx((0.1500, 0.8500), abs=1e-4)


def test_without_a_row_of_the_present_code_the_intervals_are_those_of_earlier_code_and_marked_stale() -> None:
    other = record_of(replace(RESULT, scene="apple-small-103", seed=103), "voting")
    early = changed(record_of(RESULT, "voting"), code="0123")
    table = TABLES["intervals"]([early])
    assert table.startswith("**Stale**")
    assert "| apple | 1 | 1 |" in table
    assert "Stale" not in TABLES["intervals"]([early, other])
    assert "| apple | 1 | 1 |" in TABLES["intervals"]([early, other])


def test_a_scene_is_trained_with_the_same_settings_in_all_studies() -> None:
    trainings: dict[str, set[str]] = {}
    for study in STUDIES.values():
        for trial in study.trials:
            trainings.setdefault(trial.scene, set()).add(study.training)
            assert training_of(trial) == study.training
    assert {len(each) for each in trainings.values()} == {1}
    assert training_of(STUDIES["two-photos"].trials[0]) == "quick"
    assert training_of(Trial(scene="mine-1", stage=TRUE_POSES)) == "standard"


def test_a_scene_that_cannot_be_counted_from_photos_alone_has_f1_0_in_the_mean() -> None:
    cameras = CameraErrors(placed=58, photos=60, center=0.0021, center_90=0.0053, rotation=0.08, rotation_90=0.14)
    known = record_of(RESULT, "voting")
    alone = record_of(replace(RESULT, stage=END_TO_END, cameras=cameras), "voting")
    other = record_of(replace(RESULT, scene="apple-small-103", seed=103), "voting")
    failed = StageResult(
        species="apple", seed=103, scene="apple-small-103", stage=END_TO_END, counted=None, failed="no cameras"
    )
    table = TABLES["photos-alone"]([known, alone, other, record_of(failed, "voting")])
    assert "| apple | 2 | 0.904 | 0.452 | 0.000 | 58 of 60 | 2.1, 5.3 | 0.08, 0.14 |" in table


def test_whole_trees_have_the_cameras_that_they_were_measured_with_and_failures_count_as_0() -> None:
    plum = replace(RESULT, species="plum", seed=413, scene="plum-whole-413", stage=END_TO_END)
    failed = StageResult(
        species="cherry", seed=402, scene="cherry-whole-402", stage=END_TO_END, counted=None, failed="no cameras"
    )
    lines = TABLES["whole"]([record_of(plum, "voting"), record_of(failed, "voting")]).splitlines()
    assert lines[2].startswith("| plum-whole-413 |")
    assert "|  |  |  |" in lines[2]
    assert "| 0.904 |" in lines[2]
    assert "| failed |" in lines[3]
    assert lines[4] == "| **mean** |  |  |  |  |  | 0.452 |  |"


def test_tables_that_are_made_from_the_ladder_have_its_head() -> None:
    for name in ("photos-alone", "missed"):
        text = fill(f"<!-- table {name} -->\n<!-- end -->\nafter\n<!-- end -->", [record_of(RESULT, "voting")])
        assert "119 of 120 rows are not measured yet" in text
        assert "\nafter\n" in text


def test_the_picture_of_conditions_is_the_same_each_time(tmp_path: Path) -> None:
    scores = [("as usual", 0.94), ("wind", 0.62), ("bush", 0.92)]
    for name in ("a.png", "b.png"):
        draw_conditions(scores, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
