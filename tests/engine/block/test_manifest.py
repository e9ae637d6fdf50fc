"""A manifest is read whatever a spreadsheet made of it, and what is wrong in it is one line that says where."""

from __future__ import annotations

from pathlib import Path

import pytest

from fruitlangs.engine.block.ledger import Ledger
from fruitlangs.engine.block.manifest import COLUMNS, TreeEntry, names_folder, read_manifest
from fruitlangs.engine.config import PRESETS
from fruitlangs.engine.errors import ConfigError, FormatError

LINES = "id,source,prompt,row,position\n1,photos/a,apple,A,1.5\n2,photos/b,red apple|green apple,B,2\n"


def written(folder: Path, content: str | bytes, name: str = "orchard.csv") -> Path:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def test_a_line_is_a_tree_and_paths_are_relative_to_the_manifest(tmp_path: Path) -> None:
    one, two = read_manifest(written(tmp_path, LINES))
    assert (one.id, one.source, one.row, one.position) == ("1", tmp_path / "photos" / "a", "A", 1.5)
    assert (one.prompt, two.prompt) == (("apple",), ("red apple", "green apple"))


@pytest.mark.parametrize(
    "content",
    [
        LINES.encode("utf-8-sig"),
        LINES.encode("utf-16"),
        LINES.replace(",", ";").encode(),
        LINES.replace(",", "\t").encode("cp1252"),
        LINES.replace("\n", "\r\n\r\n").encode(),
        LINES.replace("id,source", " ID , Source ").encode(),
        LINES.replace("1.5", '"1,5"').encode(),
    ],
    ids=["utf-8 with mark", "utf-16", "semicolons", "tabs", "Windows lines", "head in capitals", "decimal comma"],
)
def test_separators_encodings_and_decimal_commas_of_spreadsheets_are_understood(content: bytes, tmp_path: Path) -> None:
    assert read_manifest(written(tmp_path, content)) == read_manifest(written(tmp_path, LINES, "plain.csv"))


def test_a_name_in_windows_letters_is_read(tmp_path: Path) -> None:
    [tree] = read_manifest(written(tmp_path, "id,source,prompt\nBäume 1,photos/Süd,apple\n".encode("cp1252")))
    assert (tree.id, tree.source.name) == ("Bäume 1", "Süd")


def test_toml_gives_settings_for_all_trees_and_for_one(tmp_path: Path) -> None:
    text = """
    prompt = "lemon"
    preset = "quick"
    settings = {"count.threshold" = 0.4}
    [[tree]]
    id = "7"
    source = "a"
    [[tree]]
    id = "8"
    source = "b"
    prompt = ["apple", "pear"]
    settings = {"train.steps" = 70}
    box = [0, 0, 0, 1, 1, 2]
    metres_per_unit = 0.5
    """
    seven, eight = read_manifest(written(tmp_path, text, "orchard.toml"))
    assert (seven.prompt, eight.prompt) == (("lemon",), ("apple", "pear"))
    assert seven.config.train == PRESETS["quick"]
    assert (eight.config.train.steps, eight.config.count.threshold) == (70, 0.4)
    assert eight.config.count.box == (0.0, 0.0, 0.0, 1.0, 1.0, 2.0)
    assert eight.config.units.metres_per_unit == 0.5


def test_a_row_has_a_number_of_trees_or_the_places_of_their_trunks(tmp_path: Path) -> None:
    lines = "id,source,prompt,trees\n1,a,apple,6\n2,b,apple,0 0 0 2.5 0 0\n3,c,apple,\n"
    six, two, none = (tree.config.count for tree in read_manifest(written(tmp_path, lines)))
    assert (six.trees, six.tree_places) == (6, None)
    assert two.tree_places == (0.0, 0.0, 0.0, 2.5, 0.0, 0.0)
    assert (none.trees, none.tree_places) == (0, None)


def test_the_manifest_of_the_docs_is_read(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "batch.md").read_text(encoding="utf-8")
    one, two, row = read_manifest(written(tmp_path, page.partition("## The manifest")[2].split("```")[1].strip()))
    assert (one.prompt, two.prompt, row.trees) == (("apple",), ("red apple", "green apple"), 2)
    assert (two.config.train.steps, two.config.count.threshold) == (800, 0.4)
    assert row.config.count.tree_places == (0.0, 0.0, 0.0, 2.5, 0.0, 0.0)


def test_settings_of_yes_and_no_and_ids_that_only_resemble_those_of_a_row_are_read(tmp_path: Path) -> None:
    lines = "id,source,prompt,trees,settings\nA,a,apple,2,train.antialiased=YES\nA-3,b,apple,1,train.antialiased=no\n"
    row, tree = read_manifest(written(tmp_path, lines))
    assert (row.config.train.antialiased, tree.config.train.antialiased) == (True, False)
    assert (row.trees, tree.trees) == (2, 1)


def test_a_folder_of_folders_needs_no_manifest(tmp_path: Path) -> None:
    for name in ("tree 2", "tree 1", "notes"):
        (tmp_path / name).mkdir()
    for name in ("tree 1", "tree 2"):
        (tmp_path / name / "a.jpg").write_bytes(b"")
    trees = read_manifest(tmp_path, prompt=["plum"], settings="train.steps=5 | count.threshold = .2")
    assert [(tree.id, tree.prompt) for tree in trees] == [("tree 1", ("plum",)), ("tree 2", ("plum",))]
    assert trees[0].config.train.steps == 5
    assert trees[0].config.count.threshold == 0.2


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("", "is empty. Its first line names columns: id, source, prompt"),
        ("id,source,prompt\n", "names no tree"),
        (
            "id,source,prompt,colour\n1,a,apple,red\n",
            "unknown column of its first line: 'colour'. Known are id, source",
        ),
        ("id,source,prompt\n1,a,apple\n1,b,apple\n", "line 3 and line 2 have one id, '1'"),
        ("id,source,prompt\nA,a,apple\na,b,apple\n", "line 3 and line 2 have one id, 'a'"),
        ("id,source,prompt\n,a,apple\n", "line 2: id is missing"),
        ("id,source,prompt\n1,,apple\n", "line 2: source is missing"),
        ("id,source,prompt\n1,a,\n", "line 2: nothing says what to count"),
        ("id,source,prompt\n../1,a,apple\n", "line 2: id '../1' names a folder"),
        ("id,source,prompt\ncon,a,apple\n", "line 2: id 'con' is the name of a device on Windows"),
        ("id,source,prompt\nNul.tar.gz,a,apple\n", "line 2: id 'Nul.tar.gz' is the name of a device on Windows"),
        ("id,source,prompt\n1.,a,apple\n", "line 2: id '1.' names a folder"),
        ("id,source,prompt\n1,a,apple,more\n", "line 2 has more cells than columns"),
        ("id,source,prompt,position\n1,a,apple,near\n", "line 2: position 'near' is not a number"),
        ("id,source,prompt,preset\n1,a,apple,best\n", "line 2: preset 'best' is unknown; use quick, standard, paper"),
        ("id,source,prompt,settings\n1,a,apple,train.stepz=3\n", "line 2: 'train.stepz' is not a setting"),
        ("id,source,prompt,settings\n1,a,apple,train.steps=-3\n", "line 2: tree 1: --train.steps"),
        ("id,source,prompt,trees\n1,a,apple,2.5\n", "line 2: trees '2.5' is not a number of trees"),
        ("id,source,prompt,trees\n1,a,apple,0 0\n", "line 2: tree 1: --count.tree-places"),
        ("id,source,prompt,box\n1,a,apple,0 0 1\n", "line 2: box has 3 numbers, not six"),
        ("id,source,prompt,latitude,longitude\n1,a,apple,91,9\n", "line 2: latitude 91 is not between -90 and 90"),
        ("id,source,prompt,latitude,longitude\n1,a,apple,9,-181\n", "line 2: longitude -181 is not between -180 and"),
        ("id,source,prompt,latitude,longitude\n1,a,apple,9,\n", "line 2: latitude is given without longitude"),
        ("id,source,prompt,longitude\n1,a,apple,9\n", "line 2: longitude is given without latitude"),
        (
            "id,source,prompt,settings\n1,a,apple,train.antialiased=ture\n",
            "line 2: train.antialiased 'ture' is neither true nor false",
        ),
        ("id,source,prompt,settings\n1,a,apple,train.steps=2.5\n", "line 2: train.steps '2.5' is not a whole number"),
        (
            "id,source,prompt,trees\nA,a,apple,2\na-1,b,apple,\n",
            "'A-1' is the id of line 3 and of tree 1 of",
        ),
        (
            "id,source,prompt,trees\nA,a,apple,2\nA-2,b,apple,2\n",
            "'A-2' is the id of line 3 and of tree 2 of the row in line 2. Give one of them another id",
        ),
        ("id,source,prompt\n1,a\0,apple\n", "line 2: a value has the wrong form (embedded null byte)"),
    ],
)
def test_what_is_wrong_is_one_line_with_its_place(content: str, text: str, tmp_path: Path) -> None:
    with pytest.raises((FormatError, ConfigError)) as caught:
        read_manifest(written(tmp_path, content))
    assert text in str(caught.value)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("ending", ["", ".", " ", ".txt", ".tar.gz", " .txt"])
@pytest.mark.parametrize(
    "device",
    ["con", "PRN", "Aux", "nul", *(f"{port}{n}" for port in ("COM", "lpt") for n in (*range(10), "¹", "²", "³"))],
)
def test_no_name_of_a_device_names_a_folder(device: str, ending: str) -> None:
    assert not names_folder(f"{device}{ending}")


@pytest.mark.parametrize(
    "own", ["1", "cone", "con1", "com", "COM10", "lpt-1", "icon", "a.con", "tree con", "con-1", "nullo", "x.nul"]
)
def test_ids_that_only_resemble_the_name_of_a_device_name_a_folder(own: str) -> None:
    assert names_folder(own)


@pytest.mark.parametrize("own", ["", ".", "1.", "1 ", ".1", "a/b", "a:b", "x" * 81])
def test_ids_that_are_no_folder_on_some_system_name_none(own: str) -> None:
    assert not names_folder(own)


def test_the_folder_of_a_block_among_those_of_trees_is_no_tree(tmp_path: Path) -> None:
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "a.jpg").write_bytes(b"")
    Ledger(tmp_path / "block").write_trees(read_manifest(tmp_path, prompt=["plum"]))
    assert [tree.id for tree in read_manifest(tmp_path, prompt=["plum"])] == ["tree"]


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("tree = 3", "[[tree]]"),
        ("[[tree", "cannot be read"),
        ("colour = 1\n[[tree]]\nid='1'", "unknown column for all trees"),
        ("[[tree]]\nid='1'\nsource='a'\nprompt=3", "tree 1: a value has the wrong form"),
        ("[[tree]]\nid='1'\nsource='a'\nprompt='apple'\ntrees=[]", "tree 1: a value has the wrong form"),
        (
            "[[tree]]\nid='1'\nsource='a'\nprompt='apple'\nsettings={'train.steps'=[3]}",
            "--train.steps is [3]. Use a whole",
        ),
    ],
)
def test_a_wrong_toml_is_one_line(content: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"orchard\.toml") as caught:
        read_manifest(written(tmp_path, content, "orchard.toml"))
    assert text in str(caught.value)


def test_a_tree_is_counted_again_only_if_its_count_would_change(tmp_path: Path) -> None:
    tree = read_manifest(written(tmp_path, LINES))[0]
    moved = LINES.replace("A,1.5", "C,9")
    other = LINES.replace("1,photos/a,apple", "1,photos/a,pear")
    assert read_manifest(written(tmp_path, moved))[0].fingerprint == tree.fingerprint
    assert read_manifest(written(tmp_path, other))[0].fingerprint != tree.fingerprint
    assert {"row", "position"} < set(COLUMNS)
    assert isinstance(tree, TreeEntry)
