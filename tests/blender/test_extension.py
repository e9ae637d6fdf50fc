"""The extension as Blender gets it: the zip, by the standard library and by a real Blender."""

from __future__ import annotations

import importlib
import os
import subprocess
import tomllib
import zipfile
from pathlib import Path

import pytest

from fruitlangs.engine.config import TrainConfig

ROOT = Path(__file__).resolve().parents[2]
BLENDER = os.environ.get("FRUITLANGS_BLENDER")

needs_blender = pytest.mark.skipif(
    not BLENDER, reason="set FRUITLANGS_BLENDER to the path of a Blender program (4.2 or newer) to run this"
)


def manifest() -> dict:
    return tomllib.loads((ROOT / "blender_manifest.toml").read_text(encoding="utf-8"))


@pytest.fixture
def zip_path(tmp_path, monkeypatch):
    build_extension = importlib.import_module("build_extension")
    monkeypatch.setattr("sys.argv", ["build_extension", "--out", str(tmp_path)])
    assert build_extension.main() == 0
    (path,) = tmp_path.glob("*.zip")
    return path


def run_blender(*arguments: str, home: Path) -> str:
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(home)}
    result = subprocess.run([str(BLENDER), *arguments], env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_manifest_agrees_with_the_package():
    import fruitlangs

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert manifest()["version"] == fruitlangs.__version__ == project["version"]
    assert manifest()["license"] == [f"SPDX:{project['license']}"]


def test_zip_holds_the_code_and_none_of_the_rest(zip_path):
    names = zipfile.ZipFile(zip_path).namelist()
    for needed in ("__init__.py", "blender_manifest.toml", "LICENSE", "engine/config.py", "operators/write.py"):
        assert needed in names
    tops = {name.split("/")[0] for name in names}
    assert tops <= {"__init__.py", "blender_manifest.toml", "LICENSE", "README.md", "CHANGELOG.md"} | {
        "engine", "operators", "fruitlangs_addon"
    }  # fmt: skip
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]


def test_zip_holds_every_module_of_the_package(zip_path):
    names = set(zipfile.ZipFile(zip_path).namelist())
    for room in ("engine", "operators", "fruitlangs_addon"):
        for file in (ROOT / room).rglob("*.py"):
            assert file.relative_to(ROOT).as_posix() in names


def test_the_same_files_give_the_same_zip(zip_path, tmp_path, monkeypatch):
    first = zip_path.read_bytes()
    monkeypatch.setattr("sys.argv", ["build_extension", "--out", str(tmp_path)])
    importlib.import_module("build_extension").main()
    assert zip_path.read_bytes() == first


@pytest.mark.parametrize(
    ("pattern", "path", "is_folder", "expected"),
    [
        ("/tests/", "tests", True, True),
        ("/tests/", "engine/tests", True, False),
        ("__pycache__/", "engine/__pycache__", True, True),
        ("/docs/", "docs", False, False),
        (".*", ".venv", True, True),
        (".*", "engine/.hidden", False, True),
        ("*.zip", "a/b.zip", False, True),
        ("/constraints*.txt", "constraints-dev.txt", False, True),
        ("/constraints*.txt", "engine/constraints.txt", False, False),
    ],
)
def test_excludes_read_as_blender_reads_them(pattern, path, is_folder, expected):
    assert importlib.import_module("build_extension").excludes(pattern, path, is_folder) is expected


@needs_blender
def test_blender_packs_the_same_files(zip_path, tmp_path):
    other = tmp_path / "blender.zip"
    build = ["--command", "extension", "build", "--source-dir", str(ROOT), "--output-filepath", str(other)]
    run_blender(*build, home=tmp_path / "home")
    assert sorted(zipfile.ZipFile(other).namelist()) == sorted(zipfile.ZipFile(zip_path).namelist())


@needs_blender
def test_blender_validates_installs_and_enables_the_zip(zip_path, tmp_path):
    home = tmp_path / "home"
    run_blender("--command", "extension", "validate", str(zip_path), home=home)
    run_blender("--command", "extension", "install-file", "-r", "user_default", "-e", str(zip_path), home=home)
    script = tmp_path / "check.py"
    script.write_text(
        "import bpy\n"
        "assert 'bl_ext.user_default.fruitlangs' in bpy.context.preferences.addons\n"
        f"assert bpy.context.scene.fruitlangs.config.train.steps == {TrainConfig().steps}\n"
        "assert not bpy.ops.fruitlangs.count.poll()\n"
        "bpy.ops.preferences.addon_disable(module='bl_ext.user_default.fruitlangs')\n"
        "assert not hasattr(bpy.types.Scene, 'fruitlangs')\n"
        "print('all is well')\n"
    )
    assert "all is well" in run_blender("-b", "--python-exit-code", "1", "-P", str(script), home=home)
