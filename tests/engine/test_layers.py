"""Packages import from lower layers only: checked from the code's own imports."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

from fruitlangs.engine.reconstruction import ENCODING

ROOT = Path(__file__).resolve().parents[2]
LAYERS = (
    # The engine, from the ground up.
    ("engine/errors", "engine/progress", "engine/setting", "engine/user_folders"),
    ("engine/storage", "engine/config", "engine/compiled", "engine/child_process"),
    ("engine/scene/camera", "engine/scene/pycolmap_import"),
    ("engine/scene/orientation", "engine/scene/alignment", "engine/scene/scale", "engine/scene/walk"),
    ("engine/scene/photos",),
    ("engine/scene/formats", "engine/scene/video"),
    ("engine/scene/sfm",),
    ("engine/scene/gps", "engine/scene/read"),
    ("engine/scene/source",),
    ("engine/splatting/gaussians", "engine/splatting/kernels"),
    ("engine/splatting/rendering/workspace",),
    ("engine/splatting/rendering/render",),
    ("engine/splatting/gpu",),
    ("engine/splatting/ply", "engine/splatting/rendering", "engine/splatting/subject"),
    ("engine/splatting/training", "engine/splatting/imported"),
    ("engine/language/words",),
    ("engine/language/vocabulary",),
    ("engine/language/colours",),
    ("engine/language/taught",),
    ("engine/language/encoders",),
    ("engine/language/masks",),
    ("engine/language/features",),
    ("engine/language/prompts",),
    ("engine/language/teaching",),
    ("engine/counting/fruit", "engine/counting/geometry"),
    ("engine/counting/evidence",),
    ("engine/counting/regions", "engine/counting/published", "engine/counting/photos", "engine/counting/sizing"),
    ("engine/counting/accounts",),
    ("engine/counting/count",),
    ("engine/counting/prompted",),
    ("engine/report", "engine/compile_ahead"),
    ("engine/result_folder",),
    ("engine/evaluation/truth", "engine/evaluation/number_table"),
    ("engine/evaluation/datasets", "engine/evaluation"),
    ("engine/memory",),
    ("engine/photo_size", "engine/training"),
    ("engine/reconstruction", "engine/photo_check"),
    ("engine/publishing", "engine/scale"),
    ("engine/pipeline", "engine/open_result"),
    ("engine/block",),
    # What Blender does.
    ("operators/blender_data", "operators/package_folder"),
    ("operators/scene_frame",),
    ("operators/root_placement",),
    ("operators/jobs", "operators/viewport"),
    ("operators/settings",),
    ("operators/packages", "operators/data"),
    ("operators/photos", "operators/tools", "operators/export"),
    ("operators/drawing", "operators/review"),
    ("operators/steps",),
    ("operators/block",),
    # What Blender shows.
    (
        "fruitlangs_addon/photo_properties",
        "fruitlangs_addon/review_properties",
        "fruitlangs_addon/check_properties",
        "fruitlangs_addon/teach_properties",
        "fruitlangs_addon/block_properties",
    ),
    ("fruitlangs_addon/properties",),
    ("fruitlangs_addon/panels",),
    ("fruitlangs_addon/preferences",),
    ("fruitlangs_addon/registration",),
)
"""Packages and single modules, lowest first. Each may import from the layers below it, and from nothing else."""
LAYER = {name: layer for layer, names in enumerate(LAYERS) for name in names}
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
            for alias in node.names:
                submodule = (*module, alias.name)
                found.append(submodule if ROOT.joinpath(*submodule).with_suffix(".py").exists() else module)
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


OWN = ("benchmarks", "engine", "fitting", "fruitlangs_addon", "operators", "orchard", "scripts", "tests")
"""Folders of the project's code. Others in the checkout are environments, results or files of users."""


def tracked(path: Path) -> bool:
    """Whether a file is the project's own."""
    return path.relative_to(ROOT).parts[0] in (*OWN, "__init__.py")


def relative_name(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def place(module: tuple[str, ...]) -> str | None:
    """The package or module of `LAYERS` that holds a module; None for a package's own `__init__`."""
    names = ["/".join(module[:length]) for length in range(len(module), 0, -1)]
    return next((name for name in names if name in LAYER), None)


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_imports_go_down_only(path: Path) -> None:
    own = place(path.relative_to(ROOT).with_suffix("").parts)
    if own is None:
        return
    for module in imported_modules(path):
        other = place(module)
        assert other is not None, f"{path.name} imports {'.'.join(module)}, which has no layer"
        if other != own:
            assert LAYER[other] < LAYER[own], f"{own} (layer {LAYER[own]}) imports {other} (layer {LAYER[other]})"


def test_modules_of_a_package_do_not_import_each_other_in_a_circle() -> None:
    files = {path.relative_to(ROOT).with_suffix("").parts: path for path in SOURCES}
    imports = {own: {one[: len(one)] for one in imported_modules(path)} & set(files) for own, path in files.items()}
    done: set[tuple[str, ...]] = set()

    def visit(module: tuple[str, ...], above: tuple[tuple[str, ...], ...]) -> None:
        assert module not in above, " → ".join("/".join(each) for each in (*above, module))
        if module not in done:
            for each in imports[module]:
                visit(each, (*above, module))
            done.add(module)

    for module in files:
        visit(module, ())


WITHOUT_EFFECT = {
    "child_process", "config", "errors", "progress", "setting", "storage", "user_folders"
}  # fmt: skip
"""Parts of the engine whose code changes no output of a stage; settings are part of the keys themselves."""


def keyed_rooms(path: Path) -> list[list[str]]:
    """The packages and modules that each call of `stage_key` in a file names; none for a key that another one is in."""
    calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    found = [node.args[0] for node in calls if isinstance(node.func, ast.Name) and node.func.id == "stage_key"]
    rooms = [eval(ast.unparse(each), {"ENCODING": ENCODING}) for each in found]
    return [list(each) for each in rooms if each]


def run_by(rooms: list[str]) -> set[str]:
    """The parts of the engine that packages import, directly or not; what joins the stages is followed no further."""
    folders = [ROOT / "engine" / room for room in rooms if (ROOT / "engine" / room).is_dir()]
    waiting, seen = [path for path in SOURCES if any(path.is_relative_to(each) for each in folders)], set[Path]()
    while waiting:
        path = waiting.pop()
        if path not in seen:
            seen.add(path)
            modules = [ROOT.joinpath(*module).with_suffix(".py") for module in imported_modules(path)]
            waiting += [module for module in modules if module.is_file()]
    return {path.relative_to(ROOT / "engine").with_suffix("").parts[0] for path in seen}


def test_the_key_of_a_stage_names_all_code_that_the_stage_runs() -> None:
    rooms = [each for path in SOURCES for each in keyed_rooms(path)]
    assert len(rooms) >= 8
    assert [each for each in rooms if run_by(each) - WITHOUT_EFFECT - set(each)] == []


def test_no_folder_holds_more_than_16_modules() -> None:
    folders = Counter(path.parent for path in ROOT.rglob("*.py") if path.name != "__init__.py" and tracked(path))
    assert {folder.relative_to(ROOT).as_posix(): n for folder, n in folders.items() if n > 16} == {}


@pytest.mark.parametrize("path", SOURCES, ids=relative_name)
def test_imports_inside_the_package_are_relative(path: Path) -> None:
    assert "fruitlangs" not in absolute_imports(path)


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "engine")], ids=relative_name)
def test_engine_never_imports_blender(path: Path) -> None:
    assert not absolute_imports(path) & {"bpy", "mathutils", "bmesh", "gpu", "bl_math"}


def test_every_module_has_a_layer() -> None:
    modules = [path.relative_to(ROOT).with_suffix("").parts for path in SOURCES if path.name != "__init__.py"]
    assert ["/".join(module) for module in modules if place(module) is None] == []


def test_an_installed_package_has_every_folder_and_its_files() -> None:
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
    folders = {path.parent.relative_to(ROOT) for path in SOURCES}
    of_commands = {"fruitlangs.scripts", "fruitlangs.benchmarks", "fruitlangs.benchmarks.training"}
    expected = {"fruitlangs"} | {".".join(("fruitlangs", *folder.parts)) for folder in folders}
    assert set(tools["packages"]) == expected | of_commands
    for package, patterns in tools["package-data"].items():
        folder = ROOT.joinpath(*package.split(".")[1:])
        assert all(list(folder.glob(pattern)) for pattern in patterns), package
    stored = {path.parent.relative_to(ROOT) for path in (ROOT / "engine").rglob("*.safetensors")}
    listed = {
        Path(*package.split(".")[1:], *Path(each).parts[:-1])
        for package, patterns in tools["package-data"].items()
        for each in patterns
    }
    assert stored <= listed


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


def test_only_usable_cores_asks_how_many_cores_there_are() -> None:
    """A batch system may allow fewer than the computer has."""
    asking = [path for path in SOURCES if "cpu_count" in path.read_text()]
    assert asking == [ROOT / "engine" / "child_process.py"]
