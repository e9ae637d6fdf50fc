"""Texts that users read are plain English: words that were misread or looked translated do not come back."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    *("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "engine/report/page.html"),
    *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md")),
)
CODE = ("engine", "operators", "fruitlangs_addon", "scripts")
WORDS = {
    r"nobody": "say 'hidden fruit', 'not reviewed' or 'no user'",
    r"\bwont to\b": "say 'usually'",
    r"\banew\b": "say 'again'",
    r"\b(whence|thence|whereabouts)\b": "say 'from where', 'from there', 'location'",
    r"\b(sure|surer|surest|sureness)\b": "say 'probability' or 'confidence'",
    r"\btold\b": "say 'estimated', 'given', 'reported' or 'distinguished'",
    r"\blooked? (at|through|for)\b": "say 'review', 'show' or 'search'",
    r"\banswers?(ed)? (to|for)\b": "say 'matches the prompt'",
    r"\bkept aside\b": "say 'held-out photos'",
    r"\b(foreign|borrowed)\b": "say 'imported Gaussians'",
    r"\b(rungs?|road|twin)\b": "say 'ablation stage', 'method', 'reference implementation'",
    r"\bdoubtful\b": "say 'uncertain'",
    r"\bof no\b": "say what is missing",
    r"\bno (numbers?|fruit's|camera's) at all\b": "say what is missing",
    r"\bby itself\b|\bby themselves\b": "say 'automatically'",
    r"\bbeside\b": "say 'next to' or 'in addition to'",
    r"\bsomebody\b|\ba person\b": "say 'the user'",
    r"\bmeanwhile\b": "say what happened in that time",
    r"\bthings?\b": "say 'object'",
    r"\bin one place\b": "say 'at the same position'",
    r"\bat work\b": "say 'running'",
    r"\bmakes? (millimetres|metres) of\b": "say 'converts to millimetres'",
    r"\bgive or take\b": "say ±",
    r"\bshall\b": "say what happens, or 'is to be'",
    r"\b(is|are) none of\b": "say 'is unknown; use …' or 'is not'",
    r"\bhalf-made\b": "say 'incomplete'",
    r"\bfits? nowhere\b": "say 'could not be registered'",
    r"\bhas not the\b|\bknows no\b|\bis no\b(?! longer)": "say 'does not have', 'does not know', 'is not'",
}
"""{pattern: what to write instead}."""


WORDS_OF_CODE = (
    r"nobody", r"\bwont to\b", r"\banew\b", r"\b(whence|thence|whereabouts)\b", r"\b(surer|sureness)\b",
    r"\btold\b", r"\bkept aside\b", r"\bborrowed\b", r"\b(road|twins?|rivals?)\b", r"\bdoubtful\b", r"\bbeside\b",
    r"\bsomebody\b|\ba person\b", r"\bshall\b", r"\bhalf-made\b", r"\bmeanwhile\b",
    r"\bthings?\b", r"\blooked (at|for)\b(?!, along|: tree)",
)  # fmt: skip
"""Patterns that docstrings and comments do not have either."""


def texts_for_developers(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of the docstrings and comments of a file."""
    source = path.read_text(encoding="utf-8")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string


def user_texts(path: Path) -> Iterator[tuple[int, str]]:
    """(line, text) of the strings of a file that users may read: those with a space that are not docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    skipped = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str) or id(node) in skipped:
            continue
        if " " in node.value.strip():
            yield node.lineno, node.value


def config_texts() -> Iterator[tuple[str, str]]:
    from fruitlangs.engine.config import STAGES
    from fruitlangs.engine.setting import field_docs

    for stage, config in STAGES.items():
        yield from ((f"--{stage}.{name}", text) for name, text in field_docs(config).items())


def faults(place: str, text: str) -> list[str]:
    return [
        f"{place}: {text.strip()[:100]!r}: {advice}"
        for pattern, advice in WORDS.items()
        if re.search(pattern, text, re.IGNORECASE)
    ]


@pytest.mark.parametrize("folder", CODE)
def test_texts_in_code_have_none_of_the_words(folder: str) -> None:
    found = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        for line, text in user_texts(path):
            found += faults(f"{path.relative_to(ROOT)}:{line}", text)
    assert not found, "\n".join(found)


@pytest.mark.parametrize("folder", [*CODE, "orchard", "fitting", "benchmarks", "tests"])
def test_docstrings_and_comments_have_none_of_the_words(folder: str) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {match[0]}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path != Path(__file__)
        for line, text in texts_for_developers(path)
        for pattern in WORDS_OF_CODE
        if (match := re.search(pattern, text, re.IGNORECASE))
    ]
    assert not found, "\n".join(found)


def test_texts_of_settings_have_none_of_the_words() -> None:
    assert [fault for place, text in config_texts() for fault in faults(place, text)] == []


def test_pages_for_users_have_none_of_the_words() -> None:
    found = []
    for path in [ROOT / name for name in PAGES]:
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            found += faults(f"{path.relative_to(ROOT)}:{number}", line)
    assert not found, "\n".join(found)


def test_the_words_are_found_where_they_stand() -> None:
    assert faults("x", "5 fruit that nobody has looked at")
    assert not faults("x", "5 fruit are not reviewed yet")


@pytest.mark.parametrize("path", [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *(ROOT / "docs").glob("*.md")], ids=str)
def test_links_of_pages_lead_to_files(path: Path) -> None:
    links = re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (path.parent / link).exists()] == []


def test_the_readme_stays_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 180
