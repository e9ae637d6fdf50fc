"""The house keeps its floors: checked from the code's own imports."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FLOORS = {
    "errors": 1,
    "progress": 1,
    "files": 1,
    "compiled": 1,
    "user_folders": 1,
    "config": 2,
    "cache": 2,
    "scene": 2,
    "splatting": 3,
    "language": 4,
    "counting": 4,
    "report": 5,
    "evaluation": 5,
    "reconstruction": 6,
    "publishing": 7,
    "scale": 7,
    "opening": 8,
    "pipeline": 8,
}
"""Floor of every file and room of engine/; a higher one may import a lower one, never back."""
SOURCES = sorted(
    path
    for folder in ("engine", "operators", "fruitlangs_addon")
    for path in (ROOT / folder).rglob("*.py")
    if "__pycache__" not in path.parts
)


def imported_modules(path: Path) -> list[tuple[str, ...]]:
    """Absolute names, as parts below the root package, of what a file of the package imports from the package."""
    package = path.relative_to(ROOT).with_suffix("").parts[:-1]
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = package[: len(package) - (node.level - 1)]
            module = (*base, *(node.module.split(".") if node.module else ()))
            found += [(*module, alias.name) for alias in node.names] if node.module is None else [module]
    return found


def absolute_imports(path: Path) -> set[str]:
    """First names of a file's absolute imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            names.add(node.module.split(".")[0])
    return names


def relative_name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "engine")], ids=relative_name)
def test_engine_imports_go_down_only(path: Path) -> None:
    own = path.relative_to(ROOT / "engine").parts[0].removesuffix(".py")
    if own == "__init__":
        return
    for module in imported_modules(path):
        assert module[0] == "engine", f"{path.name} imports {'.'.join(module)}: the engine knows nothing above it"
        room = module[1] if len(module) > 1 else own
        if room != own:
            below = FLOORS[room] < FLOORS[own] or (FLOORS[own] == 1 and FLOORS[room] == 1)
            same_floor_file = FLOORS[room] == FLOORS[own] == 2 and room in ("config", "cache")
            assert below or same_floor_file, f"{own} (floor {FLOORS[own]}) imports {room} (floor {FLOORS[room]})"


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_imports_inside_the_package_are_relative(path: Path) -> None:
    assert "fruitlangs" not in absolute_imports(path)


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "engine")], ids=relative_name)
def test_engine_never_imports_blender(path: Path) -> None:
    assert not absolute_imports(path) & {"bpy", "mathutils", "bmesh", "gpu", "bl_math"}


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "operators")], ids=relative_name)
def test_operators_do_not_import_the_addon(path: Path) -> None:
    assert all(module[0] in ("engine", "operators") for module in imported_modules(path))


def test_every_room_has_a_floor() -> None:
    rooms = {path.relative_to(ROOT / "engine").parts[0].removesuffix(".py") for path in (ROOT / "engine").rglob("*.py")}
    assert rooms - {"__init__"} == set(FLOORS)


def test_the_whole_engine_imports_where_importing_bpy_raises() -> None:
    script = f"""
import importlib, pathlib, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("bpy", "mathutils"):
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
sys.path.insert(0, {str(ROOT / "scripts")!r})
import _checkout
root = pathlib.Path({str(ROOT)!r})
for path in sorted((root / "engine").rglob("*.py")):
    name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
    importlib.import_module("fruitlangs." + name)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_no_file_of_the_package_unpickles_or_evaluates() -> None:
    for path in SOURCES:
        assert "pickle" not in absolute_imports(path)
        calls = [node.func for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
        assert not [call for call in calls if isinstance(call, ast.Name) and call.id in ("eval", "exec")]
