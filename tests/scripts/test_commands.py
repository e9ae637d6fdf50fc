"""The command of an installed package."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from commands import COMMANDS, HERE, overview

import fruitlangs

ROOT = Path(__file__).resolve().parents[2]


def command(*given: str) -> subprocess.CompletedProcess[str]:
    """`fruitlangs …`, as the installed command calls it."""
    code = "import sys; from fruitlangs.scripts.commands import main; sys.argv[0] = 'fruitlangs'; main()"
    load = f"import sys; sys.path.insert(0, {str(HERE)!r}); import _checkout; sys.path.pop(0); {code}"
    line = [sys.executable, "-c", load, *given]
    return subprocess.run(line, capture_output=True, text=True, check=False, cwd="/")


def test_the_installed_command_is_this_one() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert project["scripts"] == {"fruitlangs": "fruitlangs.scripts.commands:main"}


def test_every_command_is_listed_with_what_it_does() -> None:
    text = overview()
    for name, script in COMMANDS.items():
        assert (HERE / script).is_file()
        assert any(line.split()[0] == name and len(line.split()) > 3 for line in text.splitlines()[3:-2])


@pytest.mark.parametrize("name", ["check", "count", "orchard", "teach", "compare", "check-gpu"])
def test_a_command_calls_itself_as_the_user_did(name: str) -> None:
    done = command(name, "--help")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"usage: fruitlangs {name} ")
    assert "python scripts" not in done.stdout or name in ("compare", "check-gpu")


def test_errors_and_exit_codes_are_those_of_the_script(tmp_path: Path) -> None:
    done = command("count", str(tmp_path / "none"), "--prompt", "apple", "--out", str(tmp_path / "out"))
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert len(done.stderr.splitlines()) == 1


def test_an_unknown_command_is_exit_2_with_those_that_there_are() -> None:
    done = command("cuont")
    assert done.returncode == 2
    assert done.stderr.startswith("error: 'cuont' is not a command\n")
    assert "  count " in done.stderr


def test_version_is_that_of_the_package() -> None:
    assert command("--version").stdout == f"fruitlangs {fruitlangs.__version__}\n"


def test_python_m_fruitlangs_is_the_same_command(tmp_path: Path) -> None:
    (tmp_path / "fruitlangs").symlink_to(ROOT)
    line = [sys.executable, "-m", "fruitlangs", "--version"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run(line, capture_output=True, text=True, check=False, cwd="/", env=environment)
    assert done.stdout == f"fruitlangs {fruitlangs.__version__}\n", done.stderr
