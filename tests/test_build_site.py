"""The documentation site is built without a broken link, and its references have every setting and name."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import build_site
import pytest

import fruitlangs
from fruitlangs.engine.config import STAGES
from fruitlangs.engine.errors import FruitLangsError


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built where other runs do not."""
    checkout = tmp_path_factory.mktemp("site") / "checkout"
    build_site.build(checkout)
    return checkout / "site"


def test_every_page_of_docs_is_in_the_site(site: Path) -> None:
    pages = {path.stem for path in (build_site.ROOT / "docs").glob("*.md")}
    assert {path.stem for path in (site / "docs").glob("*.html")} == pages


def test_the_reference_of_settings_has_every_setting(site: Path) -> None:
    text = (site / "reference" / "settings.html").read_text(encoding="utf-8")
    flags = [
        f"--{stage}.{each.name.replace('_', '-')}"
        for stage, kind in STAGES.items()
        for each in dataclasses.fields(kind)
    ]
    assert [flag for flag in flags if flag not in text] == []


def test_the_reference_of_python_names_has_the_arguments_and_errors_of_count_scene(site: Path) -> None:
    text = (site / "reference" / "python.html").read_text(encoding="utf-8")
    assert [name for name in fruitlangs.__all__ if f"fruitlangs.{name}" not in text] == []
    assert "A fruit must match one of them" in text or "a fruit must match one of them" in text
    assert "earlier results in" in text


def test_a_link_that_leads_nowhere_is_an_error(site: Path, tmp_path: Path) -> None:
    shutil.copytree(site.parent / "site-pages", tmp_path / "site-pages")
    with (tmp_path / "site-pages" / "docs" / "count.md").open("a", encoding="utf-8") as page:
        page.write("\n[nowhere](nowhere.md)\n")
    with pytest.raises(FruitLangsError, match="not built"):
        build_site.make_html(tmp_path)
