"""The extension as Blender gets it: the zip, by the standard library and by a real Blender."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from tiny_wheels import make_wheel

from fruitlangs.engine.config import TrainConfig
from fruitlangs.operators.packages.package_versions import SERIES

ROOT = Path(__file__).resolve().parents[3]
SAMPLE = ROOT / "examples" / "orchard_tree"
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


@pytest.fixture
def build(tmp_path, monkeypatch):
    """Build the zip with wheels for one series of Blender; its one package is at hand, so pip is not asked."""
    build_extension = importlib.import_module("build_extension")
    monkeypatch.setattr(build_extension, "versions_for", lambda numpy, platform: {"grafting": "1.0"})
    monkeypatch.setattr(build_extension, "_download", lambda *_: pytest.fail("pip was asked"))

    def build(blender: str, platform: str = "linux-x64", out: Path = tmp_path / "dist") -> Path:
        series = next(one for one in SERIES if one.name == blender)
        make_wheel(out / "wheels" / f"{platform}-python{series.python}", "grafting", code="YEAR = 1898\n")
        return build_extension.build_with_wheels(out, series, build_extension.PLATFORMS[platform])

    return build


def manifest_of(path: Path) -> dict:
    return tomllib.loads(zipfile.ZipFile(path).read("blender_manifest.toml").decode())


def run_blender(*arguments: str, home: Path) -> str:
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(home)}
    result = subprocess.run([str(BLENDER), *arguments], env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def test_manifest_agrees_with_the_package():
    import fruitlangs

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert manifest()["version"] == fruitlangs.__version__
    assert "version" in project["dynamic"]
    assert "\nversion:" not in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    licences = project["license"].split(" AND ")
    assert manifest()["license"] == [f"SPDX:{licence}" for licence in licences]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^license:\n((?:  - .*\n)+)", citation, re.M)[1].split()[1::2] == licences


def test_zip_holds_the_code_and_none_of_the_rest(zip_path):
    names = zipfile.ZipFile(zip_path).namelist()
    for needed in ("__init__.py", "blender_manifest.toml", "LICENSE", "engine/config.py", "operators/data/write.py"):
        assert needed in names
    tops = {name.split("/")[0] for name in names}
    assert tops <= {"__init__.py", "blender_manifest.toml", "LICENSE", "README.md", "CHANGELOG.md"} | {
        "engine", "operators", "fruitlangs_addon", "LICENSES"
    }  # fmt: skip
    assert not [name for name in names if "__pycache__" in name or name.endswith(".pyc")]


STRANGERS = [
    "tree7-check/contact_sheet.jpg", "photos/IMG_1.jpg", "tree7_fruit/fruits.json", "IMG_2.jpg", "notes.txt", "mine.py",
    "my tools/code.py", ".cache/photo.jpg", "engine/IMG_3.jpg", "engine/mine/code.py", "engine/mine/photo.jpg",
    "engine/._config.py", "engine/counting/accounts/fruits.json", "engine/language/encoders/weights/mine/a.png",
    "operators/results/fruits.json", "operators/steps/contact_sheet.jpg", "fruitlangs_addon/panels/photos/IMG_4.jpg",
    "LICENSES/IMG_5.jpg", "engine/__pycache__/config.cpython-311.pyc", "docs/engine/config.py",
]  # fmt: skip
"""Files of users in a checkout."""


def blender_patterns():
    """Blender's own reading of patterns."""
    folders = importlib.util.find_spec("bpy").submodule_search_locations if importlib.util.find_spec("bpy") else []
    found = [
        file for folder in folders for file in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")
    ]
    if not found:
        pytest.skip("the bpy module, whose extension builder is asked, is not installed")
    spec = importlib.util.spec_from_file_location("blender_ext", found[0])
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.PathPatternMatch


def packed_by_blender(root: Path, patterns: list[str]) -> list[str]:
    """The files below a folder that Blender packs, besides the manifest."""
    excluded = blender_patterns()(patterns)

    def below(folder: Path) -> list[Path]:
        kept = []
        for path in folder.iterdir():
            name = path.relative_to(root).as_posix()
            if not excluded.test_path(name + "/" if path.is_dir() else name):
                kept += below(path) if path.is_dir() else [path]
        return kept

    return sorted(path.relative_to(root).as_posix() for path in below(root))


@pytest.fixture
def visited(tmp_path):
    """A checkout in which users left files, and the names of the project's own."""
    build_extension = importlib.import_module("build_extension")
    own = [name for name in build_extension.list_own_files(manifest()) if name != "blender_manifest.toml"]
    root = tmp_path / "visited"
    for name in own + STRANGERS:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(name)
    (root / "engine" / "linked.py").symlink_to(root / "mine.py")
    return root, sorted(own)


def test_what_users_leave_in_the_checkout_is_in_no_zip(visited):
    root, own = visited
    patterns = manifest()["build"]["paths_exclude_pattern"]
    found = importlib.import_module("build_extension").list_included_files(root, patterns)
    assert sorted(path.relative_to(root).as_posix() for path in found) == own


def test_blender_leaves_out_what_users_leave_in_the_checkout_too(visited):
    root, own = visited
    (root / "engine" / "linked.py").unlink()  # Blender skips links before it reads patterns
    assert packed_by_blender(root, manifest()["build"]["paths_exclude_pattern"]) == own


def test_the_manifest_allows_the_folders_of_the_package_and_their_files(zip_path):
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    packages = {name.removeprefix("fruitlangs.").replace(".", "/") for name in tools["packages"]}
    tops = ("engine", "operators", "fruitlangs_addon")
    expected = {name for name in packages if name.split("/")[0] in tops}
    data = {
        file.relative_to(ROOT).as_posix()
        for package, patterns in tools["package-data"].items()
        if package != "fruitlangs"
        for pattern in patterns
        for file in ROOT.joinpath(*package.split(".")[1:]).glob(pattern)
    }
    allowed = {each[2:] for each in manifest()["build"]["paths_exclude_pattern"] if each.startswith("!")}
    assert {each for each in allowed if (ROOT / each).is_dir()} == expected | {"LICENSES"} | {
        Path(name).parent.as_posix() for name in data
    }
    assert data <= set(zipfile.ZipFile(zip_path).namelist())


def test_zip_holds_every_module_of_the_package(zip_path):
    names = set(zipfile.ZipFile(zip_path).namelist())
    for room in ("engine", "operators", "fruitlangs_addon"):
        for file in (ROOT / room).rglob("*.py"):
            assert file.relative_to(ROOT).as_posix() in names


def test_the_small_zip_is_built_by_a_python_without_packages(zip_path, tmp_path):
    script = ROOT / "scripts" / "developer" / "build_extension.py"
    subprocess.run([sys.executable, "-S", str(script), "--out", str(tmp_path)], check=True, capture_output=True)
    (built,) = tmp_path.glob("*.zip")
    assert built.read_bytes() == zip_path.read_bytes()


def test_the_same_files_give_the_same_zip(zip_path, tmp_path, monkeypatch):
    first = zip_path.read_bytes()
    monkeypatch.setattr("sys.argv", ["build_extension", "--out", str(tmp_path)])
    importlib.import_module("build_extension").main()
    assert zip_path.read_bytes() == first


def test_the_small_zip_holds_no_wheels_and_is_for_every_blender(zip_path):
    assert not [name for name in zipfile.ZipFile(zip_path).namelist() if name.endswith(".whl")]
    assert {"wheels", "platforms", "blender_version_max"}.isdisjoint(manifest_of(zip_path))
    assert manifest_of(zip_path)["blender_version_min"] == SERIES[0].first == "4.2.0"


@pytest.mark.parametrize(
    ("blender", "first", "before"), [("4.2", "4.2.0", "4.5.0"), ("4.5", "4.5.0", "5.1.0"), ("5.1", "5.1.0", None)]
)
def test_a_zip_with_wheels_is_for_the_blenders_whose_python_and_numpy_they_fit(build, blender, first, before):
    path = build(blender, "macos-arm64")
    told = manifest_of(path)
    assert path.name == f"fruitlangs-{manifest()['version']}-blender{blender}-macos-arm64.zip"
    assert told["wheels"] == ["./wheels/grafting-1.0-py3-none-any.whl"]
    assert (told["platforms"], told["blender_version_min"]) == (["macos-arm64"], first)
    assert told.get("blender_version_max") == before
    changed = {"wheels", "platforms", "blender_version_min", "blender_version_max"}
    assert {name: told[name] for name in told.keys() - changed} == {
        name: value for name, value in manifest().items() if name not in changed
    }


def test_a_zip_with_wheels_holds_the_code_the_wheels_and_nothing_else(build, zip_path):
    names = set(zipfile.ZipFile(build("4.5")).namelist())
    assert names == {*zipfile.ZipFile(zip_path).namelist(), "wheels/grafting-1.0-py3-none-any.whl"}


def test_the_same_wheels_give_the_same_zip_at_any_time(build, monkeypatch):
    first = build("4.2").read_bytes()
    monkeypatch.setattr("time.time", lambda: 2e9)
    assert build("4.2").read_bytes() == first


def test_a_wheel_of_numpy_is_never_packed(build, tmp_path):
    make_wheel(tmp_path / "dist" / "wheels" / "linux-x64-python3.11", "numpy", version="1.26.4")
    assert not [name for name in zipfile.ZipFile(build("4.5")).namelist() if "numpy" in name]


def test_what_a_zip_holds_is_listed_by_size(build):
    table = importlib.import_module("build_extension").contents_table(build("4.5"))
    assert "MB  engine/" in table
    assert "MB  grafting 1.0" in table


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
        ("*", "engine/config.py", False, True),
        ("/engine/[!.]*.py", "engine/config.py", False, True),
        ("/engine/[!.]*.py", "engine/._config.py", False, False),
        ("/engine/[!.]*.py", "engine/scene/read.py", False, False),
        ("/engine/*/[!.]*.py", "engine/scene/read.py", False, True),
    ],
)
def test_patterns_are_read_as_blender_reads_them(pattern, path, is_folder, expected):
    assert importlib.import_module("build_extension").matches(pattern, path, is_folder) is expected
    assert blender_patterns()([pattern]).test_path(path + "/" if is_folder else path) is expected


@pytest.mark.parametrize("patterns", [["*", "!/kept"], ["!/kept", "*"]])
def test_a_pattern_that_keeps_wins_wherever_it_stands(patterns):
    is_excluded = importlib.import_module("build_extension").is_excluded
    for path, expected in (("kept", False), ("other", True)):
        assert is_excluded(path, True, patterns) is expected
        assert blender_patterns()(patterns).test_path(path + "/") is expected


@needs_blender
def test_blender_packs_the_same_files(zip_path, tmp_path):
    other = tmp_path / "blender.zip"
    build = ["--command", "extension", "build", "--source-dir", str(ROOT), "--output-filepath", str(other)]
    run_blender(*build, home=tmp_path / "home")
    assert sorted(zipfile.ZipFile(other).namelist()) == sorted(zipfile.ZipFile(zip_path).namelist())


@needs_blender
def test_blender_validates_a_zip_with_wheels(build, tmp_path):
    for series in SERIES:
        run_blender("--command", "extension", "validate", str(build(series.name)), home=tmp_path / "home")


@needs_blender
def test_blender_validates_installs_and_enables_the_zip(zip_path, tmp_path):
    home = tmp_path / "home"
    run_blender("--command", "extension", "validate", str(zip_path), home=home)
    run_blender("--command", "extension", "install-file", "-r", "user_default", "-e", str(zip_path), home=home)
    script = tmp_path / "check.py"
    script.write_text(
        "import bpy\n"
        "from pathlib import Path\n"
        "assert 'bl_ext.user_default.fruitlangs' in bpy.context.preferences.addons\n"
        f"assert bpy.context.scene.fruitlangs.config.train.steps == {TrainConfig().steps}\n"
        "assert not bpy.ops.fruitlangs.count.poll()\n"
        "from bl_ext.user_default.fruitlangs.operators.packages import dependencies\n"
        "assert Path(bpy.utils.user_resource('EXTENSIONS')) in dependencies.packages_folder().parents\n"
        "if not dependencies.find_missing_packages():\n"
        f"    bpy.context.scene.fruitlangs.source = {str(SAMPLE)!r}\n"
        "    bpy.ops.fruitlangs.import_scene()\n"
        "    assert bpy.context.scene.fruitlangs.result.cameras == 60\n"
        "bpy.ops.preferences.addon_disable(module='bl_ext.user_default.fruitlangs')\n"
        "assert not hasattr(bpy.types.Scene, 'fruitlangs')\n"
        "print('all is well')\n"
    )
    assert "all is well" in run_blender("-b", "--python-exit-code", "1", "-P", str(script), home=home)
