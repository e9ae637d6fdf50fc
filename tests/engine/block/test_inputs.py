"""A count is of its present inputs or says that it is not: photos, models, words and the program may change."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from fruitlangs.engine.block import inputs as inputs_module
from fruitlangs.engine.block.inputs import Inputs, check_inputs, list_source_files, read_inputs
from fruitlangs.engine.block.ledger import Ledger, TreeState
from fruitlangs.engine.block.manifest import TreeEntry
from fruitlangs.engine.block.worker import work

MISSING = "is missing or empty, so its earlier count is kept unchecked"
FILES_CHANGED = "files of its source were added, removed or changed"


def photo(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (8, 8)).save(path)


def written(path: Path, content: str = "1") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def touched(path: Path) -> None:
    """Another modification time, and nothing else."""
    stat = path.stat()
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns + 1))


def replaced(path: Path, content: str) -> None:
    """Another content of the same modification time, as a copy that keeps times has."""
    stat = path.stat()
    path.write_text(content)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


@pytest.fixture
def tree(tmp_path: Path) -> TreeEntry:
    """A tree with a folder of three photos, a COLMAP model and a mask."""
    source = tmp_path / "tree"
    for number in range(3):
        photo(source / "images" / f"{number}.jpg")
    photo(source / "masks" / "0.png")
    for name in ("cameras", "images", "points3D"):
        written(source / "sparse" / "0" / f"{name}.txt")
    return TreeEntry(id="1", source=source, prompt=("apple",), settings={"embed.words": str(tmp_path / "words")})


@pytest.mark.parametrize(
    "change",
    [
        lambda source: photo(source / "images" / "3.jpg"),
        lambda source: (source / "images" / "0.jpg").unlink(),
        lambda source: (source / "images" / "0.jpg").rename(source / "images" / "9.jpg"),
        lambda source: replaced(source / "images" / "0.jpg", "another photo"),
        lambda source: touched(source / "images" / "0.jpg"),
        lambda source: touched(source / "masks" / "0.png"),
        lambda source: touched(source / "sparse" / "0" / "points3D.txt"),
        lambda source: photo(source / "0.JPG"),
        lambda source: written(source / "transforms.json", "{"),
    ],
    ids=["added", "removed", "renamed", "resized", "rewritten", "mask", "model", "capitals", "other model"],
)
def test_a_changed_file_of_a_source_makes_its_count_outdated(change: Callable[[Path], object], tree: TreeEntry) -> None:
    before = read_inputs(tree)
    assert (check_inputs(tree, before).outdated, check_inputs(tree, before).note) == (False, "")
    change(tree.source)
    assert check_inputs(tree, before).outdated
    assert check_inputs(tree, before).note == FILES_CHANGED


@pytest.mark.parametrize(
    "change",
    [
        lambda source: written(source / "notes.md"),
        lambda source: written(source / "images" / ".0.jpg"),
        lambda source: written(source / "result" / "fruits.json") and photo(source / "result" / "still.jpg"),
        lambda source: written(source / "block" / "manifest.json") and written(source / "block" / "states" / "1.json"),
        lambda source: (source / "images" / "all").symlink_to(source),
    ],
    ids=["notes", "hidden", "a result", "a block", "a link to itself"],
)
def test_other_files_in_the_folder_of_a_source_change_nothing(
    change: Callable[[Path], object], tree: TreeEntry
) -> None:
    before = read_inputs(tree)
    change(tree.source)
    assert not check_inputs(tree, before).outdated


def test_photos_of_a_model_that_lie_above_it_belong_to_its_source(tree: TreeEntry) -> None:
    model = replace(tree, source=tree.source / "sparse" / "0")
    before = read_inputs(model)
    touched(tree.source / "images" / "0.jpg")
    assert check_inputs(model, before).outdated
    before = read_inputs(model)
    touched(tree.source / "masks" / "0.png")
    assert check_inputs(model, before).outdated


def test_photos_elsewhere_that_a_transforms_json_names_belong_to_it(tmp_path: Path) -> None:
    photo(tmp_path / "elsewhere" / "0.jpg")
    frames = {"frames": [{"file_path": f"../elsewhere/{k}.jpg"} for k in (0, 0, 0)]}
    file = written(tmp_path / "tree" / "transforms.json", json.dumps(frames))
    for source in (file, file.parent):
        tree = TreeEntry(id="1", source=source, prompt=("apple",))
        before = read_inputs(tree)
        touched(tmp_path / "elsewhere" / "0.jpg")
        assert check_inputs(tree, before).outdated


@pytest.mark.parametrize("name", ["row.mp4", "gaussians.ply"])
def test_a_source_of_one_file_is_that_file(name: str, tmp_path: Path) -> None:
    source = written(tmp_path / name)
    tree = TreeEntry(id="1", source=source, prompt=("apple",))
    before = read_inputs(tree)
    written(tmp_path / "another.ply")
    assert not check_inputs(tree, before).outdated
    touched(source)
    assert check_inputs(tree, before).outdated


@pytest.mark.parametrize(
    ("name", "outdated"), [("features.safetensors", True), ("fruits.json", True), ("report.html", False)]
)
def test_of_an_earlier_result_only_the_files_that_are_read_belong_to_the_source(
    name: str, outdated: bool, tmp_path: Path
) -> None:
    for file in ("fruits.json", "gaussians.ply", "cameras.json", "features.safetensors", "report.html"):
        written(tmp_path / "result" / file)
    tree = TreeEntry(id="1", source=tmp_path / "result", prompt=("apple",))
    before = read_inputs(tree)
    touched(tmp_path / "result" / name)
    assert check_inputs(tree, before).outdated == outdated


@pytest.mark.parametrize(
    ("prompt", "word", "outdated"),
    [
        ("apple", "apple", True),
        ("red Apples", "apple", True),
        ("cherry tomatoes", "cherry-tomato", True),
        ("apple", "fig", False),
    ],
)
def test_a_word_that_was_taught_again_makes_counts_of_it_outdated(
    prompt: str, word: str, outdated: bool, tree: TreeEntry, tmp_path: Path
) -> None:
    own = replace(tree, prompt=(prompt,))
    before = read_inputs(own)
    file = written(tmp_path / "words" / f"{word}.fruitword")
    check = check_inputs(own, before)
    assert check.outdated == outdated
    assert check.note == ("taught words, the template or the checkpoint that it uses have changed" if outdated else "")
    before = read_inputs(own)
    touched(file)
    assert check_inputs(own, before).outdated == outdated


def test_a_taught_word_in_a_negative_belongs_to_the_inputs(tree: TreeEntry, tmp_path: Path) -> None:
    own = replace(tree, negative=("fig",))
    before = read_inputs(own)
    written(tmp_path / "words" / "fig.fruitword")
    assert check_inputs(own, before).outdated


def test_the_template_and_a_checkpoint_of_this_computer_belong_to_the_inputs(tree: TreeEntry, tmp_path: Path) -> None:
    template, weights = written(tmp_path / "fruit.ply"), written(tmp_path / "clip" / "model.safetensors")
    settings = {"count.method": "template", "count.template": str(template)}
    settings |= {"embed.encoder": "clip", "embed.clip": str(weights.parent)}
    own = replace(tree, settings={**tree.settings, **settings})
    for file in (template, weights):
        before = read_inputs(own)
        touched(file)
        assert check_inputs(own, before).outdated


def test_another_version_of_the_program_makes_a_count_outdated(
    tree: TreeEntry, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = read_inputs(tree)
    monkeypatch.setattr(inputs_module, "program_key", lambda: "newer")
    assert check_inputs(tree, before).note == "another version of this program counted it"
    touched(tree.source / "images" / "0.jpg")
    assert check_inputs(tree, before).note == f"{FILES_CHANGED}; another version of this program counted it"


def test_a_count_of_a_version_that_noted_no_inputs_is_outdated(tree: TreeEntry) -> None:
    check = check_inputs(tree, Inputs())
    assert check.outdated
    assert "an earlier version counted it" in check.note


@pytest.mark.parametrize("before", [Inputs(), Inputs(files="1", words="2", program="3")])
def test_the_count_of_a_tree_whose_source_is_missing_is_kept_with_a_note(before: Inputs, tmp_path: Path) -> None:
    tree = TreeEntry(id="1", source=tmp_path / "gone", prompt=("apple",))
    (tmp_path / "empty").mkdir()
    for source in (tree.source, tmp_path / "empty"):
        check = check_inputs(replace(tree, source=source), before)
        assert not check.outdated
        assert check.note == f"its source {source} {MISSING}"


def test_settings_of_another_version_make_a_count_outdated(tree: TreeEntry) -> None:
    for name in ("train.no_such_setting", "no_such_stage.steps"):
        check = check_inputs(replace(tree, settings={name: 1}), read_inputs(tree))
        assert check.outdated
        assert check.note.startswith("its settings are of another version of this program")


@pytest.fixture
def ledger(tree: TreeEntry, tmp_path: Path) -> Ledger:
    """A block of two trees of one folder each, which were counted."""
    photo(tmp_path / "other" / "0.jpg")
    found = Ledger(tmp_path / "block")
    found.write_trees([tree, replace(tree, id="2", source=tmp_path / "other")])
    assert work(found, "one", count=counted) == 2
    return found


def counted(tree: TreeEntry, ledger: Ledger) -> None:
    """A stand-in for a count."""
    written(ledger.result(tree).path / "fruits.json", "{}")


def stages(ledger: Ledger) -> list[str]:
    return [state.stage for state in ledger.states().values()]


def test_only_the_tree_whose_photos_changed_is_counted_again(ledger: Ledger, tree: TreeEntry) -> None:
    ledger.reopen()
    assert stages(ledger) == ["done", "done"]
    photo(tree.source / "images" / "3.jpg")
    assert stages(ledger) == ["done", "done"]  # until a command checks them
    ledger.reopen()
    assert stages(ledger) == ["waiting", "done"]
    assert ledger.states()["1"].reason == FILES_CHANGED
    again: list[str] = []

    def noted(tree: TreeEntry, own: Ledger) -> None:
        again.append(own.state(tree).reason)
        counted(tree, own)

    assert work(ledger, "two", count=noted) == 1
    assert again == [FILES_CHANGED]
    assert ledger.states()["1"].reason == ""
    ledger.reopen()
    assert stages(ledger) == ["done", "done"]


def test_a_photo_that_is_added_during_a_count_is_counted_the_next_time(ledger: Ledger, tree: TreeEntry) -> None:
    def add(tree: TreeEntry, own: Ledger) -> None:
        photo(tree.source / "images" / "4.jpg")
        counted(tree, own)

    photo(tree.source / "images" / "3.jpg")
    ledger.reopen()
    work(ledger, "two", count=add)
    ledger.reopen()
    assert stages(ledger) == ["waiting", "done"]


def test_trees_of_a_block_of_an_earlier_version_are_counted_again(ledger: Ledger) -> None:
    path = ledger.path / "states" / "1.json"
    stored = json.loads(path.read_text())
    del stored["inputs"]
    path.write_text(json.dumps(stored))
    assert stages(ledger) == ["done", "done"]
    ledger.reopen()
    assert stages(ledger) == ["waiting", "done"]


@pytest.mark.parametrize("inputs", [3, [], {"files": 3}, {"colour": "red"}])
def test_a_state_with_damaged_inputs_is_a_tree_that_waits(inputs: object, ledger: Ledger) -> None:
    path = ledger.path / "states" / "1.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "inputs": inputs}))
    assert stages(ledger) == ["waiting", "done"]


def test_a_tree_that_another_process_counts_is_not_reopened(ledger: Ledger, tree: TreeEntry) -> None:
    photo(tree.source / "images" / "3.jpg")
    with ledger.claim(tree):
        ledger.reopen()
        assert ledger.state(tree).stage == "done"


def test_only_a_tree_that_is_done_is_compared_with_its_inputs(ledger: Ledger, tree: TreeEntry) -> None:
    interrupted = TreeState(stage="running", fingerprint=tree.fingerprint, crashes=2)
    ledger.write(tree, interrupted)
    ledger.reopen()
    assert ledger.state(tree) == interrupted
    ledger.write(tree, TreeState(stage="failed", fingerprint=tree.fingerprint, reason="no photos"))
    ledger.reopen()
    assert ledger.state(tree) == TreeState(fingerprint=tree.fingerprint)


def test_files_are_listed_and_not_read(tree: TreeEntry, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "open", lambda *_, **__: pytest.fail("read"))
    monkeypatch.setattr(Path, "read_bytes", lambda *_: pytest.fail("read"))
    assert len(list_source_files(tree.source)) == 7
    assert TreeState(stage="done", inputs=read_inputs(tree)).inputs.files
