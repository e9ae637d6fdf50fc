"""The workflows of continuous integration call what this repository has."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_every_target_that_a_workflow_makes_is_in_the_makefile(workflow: Path) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z]+):", makefile, re.MULTILINE))
    variables = set(re.findall(r"^([A-Z_]+) (?:\?=|:=)", makefile, re.MULTILINE)) | {"ZIPS"}
    text = re.sub(r"\$\{\{.+?\}\}|\"", "", workflow.read_text(encoding="utf-8"))
    calls = re.findall(r"run: make (.+)", text)
    assert calls
    for word in " ".join(calls).split():
        name, equals, _ = word.partition("=")
        assert name in (variables if equals else targets), word
