"""Build the documentation site into build/site.

    python scripts/developer/build_site.py

Its pages are those of the repository, with everything that they link to, and references that are generated from the
code. A link that leads nowhere ends the build with exit code 1.
"""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import _checkout  # noqa: F401  puts the checkout on the path

import fruitlangs
from _help import STAGES as HEADINGS
from _terminal import report, run
from fruitlangs.engine.config import STAGES
from fruitlangs.engine.errors import FruitLangsError
from fruitlangs.engine.setting import LARGEST, Range, field_docs, level_of, range_of
from fruitlangs.engine.storage.files import write_text

ROOT = Path(__file__).resolve().parents[2]
PAGES = "site-pages"
"""Folder, below that of the build, of the pages in Markdown."""
FIRST = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")
"""Pages that are in the site although nothing has to link to them, besides those of docs/."""
LINK = re.compile(r"\]\(([^)#\s]+)")


def main() -> None:
    build(ROOT / "build")
    report("The site is in build/site; open build/site/index.html")


def build(folder: Path) -> None:
    """Write folder/site from the repository.

    Raises:
        FruitLangsError: a page has a link that leads nowhere, or mkdocs is not installed.
    """
    shutil.rmtree(folder / PAGES, ignore_errors=True)
    collect_pages(folder / PAGES)
    write_text(folder / PAGES / "reference" / "settings.md", settings_page())
    write_text(folder / PAGES / "reference" / "python.md", python_page())
    make_html(folder)


def make_html(folder: Path) -> None:
    """Turn folder/site-pages into folder/site.

    Raises:
        FruitLangsError: see `build`.
    """
    package = folder / "site-package" / "fruitlangs"
    shutil.rmtree(package, ignore_errors=True)
    package.mkdir(parents=True)
    for name in ("__init__.py", "engine"):  # all that is documented; other folders would take a minute to read
        (package / name).symlink_to(ROOT / name)
    settings = shutil.copyfile(ROOT / "mkdocs.yml", folder / "mkdocs.yml")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--config-file", str(settings)]
    quiet = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, env=quiet, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.startswith(("WARNING", "ERROR"))]
        raise FruitLangsError(f"The site was not built. Mend this first: {'; '.join(lines) or done.stderr[-500:]}")


def collect_pages(pages: Path) -> None:
    """Copy the pages, and every file of the repository that they link to, also through other pages, into a folder."""
    waiting = [ROOT / name for name in FIRST] + sorted((ROOT / "docs").glob("*.md"))
    copied: set[Path] = set()
    while waiting:
        path = waiting.pop()
        if path in copied:
            continue
        copied.add(path)
        target = pages / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        if path.suffix == ".md":
            waiting += find_linked_files(path)


def find_linked_files(page: Path) -> Iterator[Path]:
    """Find the files of the repository that a page links to."""
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" not in link:
            path = (page.parent / link).resolve()
            if path.is_file() and path.is_relative_to(ROOT):
                yield path


def settings_page() -> str:
    """Every setting of every stage with its default, range and text."""
    parts = [
        "# Settings",
        "Each is a flag of the command line, such as `--train.steps 2000`, a field of `Config` in Python and a "
        "property in Blender. Common settings are shown first there, experimental ones in a group of their own.",
    ]
    for stage, config in STAGES.items():
        docs = field_docs(config)
        parts.append(f"## {HEADINGS[stage].partition(' (')[0]}")
        for setting in dataclasses.fields(config):
            facts = [f"default `{setting.default}`", _range_text(range_of(setting)), level_of(setting)]
            parts += [
                f"### --{stage}.{setting.name.replace('_', '-')}",
                docs.get(setting.name, ""),
                ", ".join(filter(None, facts)),
            ]
    return "\n\n".join(parts) + "\n"


def _range_text(allowed: Range | None) -> str:
    if allowed is None or allowed.high < LARGEST or allowed.open:
        return str(allowed or "")
    return f"at least {allowed.low:g}"


def python_page() -> str:
    """The exported names with their docstrings."""
    names = [f"::: fruitlangs.{name}" for name in fruitlangs.__all__]
    first = "[Use it from Python](../docs/python.md) shows how, [Settings](settings.md) what `Config` holds."
    return "\n\n".join(["# Python names", first, *names]) + "\n"


if __name__ == "__main__":
    run(main)
