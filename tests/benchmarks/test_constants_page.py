"""The page of constants that were chosen on reported scenes says what the code has."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "benchmarks" / "log" / "constants.md"


def rows() -> list[list[str]]:
    """The cells of each row with a value: constants, file, value, scenes, and what was chosen again."""
    table = (
        PAGE.read_text(encoding="utf-8").partition("## Chosen on scenes that tables report")[2].partition("\n## ")[0]
    )
    lines = [line for line in table.splitlines() if line.startswith("| `")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


@pytest.mark.parametrize("cells", rows(), ids=lambda cells: cells[0])
def test_a_constant_of_the_page_has_the_value_that_the_code_has(cells: list[str]) -> None:
    names = re.findall(r"`(\w+)`", cells[0])
    module = importlib.import_module("fruitlangs." + cells[1].strip("`").removesuffix(".py").replace("/", "."))
    values = ast.literal_eval(f"[{cells[2]}]")
    assert [getattr(module, name) for name in names] == values


def test_the_page_lists_the_constants_that_were_chosen_on_the_sample() -> None:
    listed = {name for cells in rows() for name in re.findall(r"`(\w+)`", cells[0])}
    assert {"USUAL", "DOUBT", "SUNKEN", "KEPT_APART", "LEAST_SHARE"} <= listed
