"""The state of the code that a measurement depends on, and where and when it was measured."""

from __future__ import annotations

import ast
import platform
import subprocess
from datetime import UTC, datetime
from functools import cache
from pathlib import Path

from ...engine.child_process import usable_cores
from ...engine.storage.files import file_hash, text_hash
from ..orchards import PRESETS

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ("engine/scene", "engine/splatting", "engine/language", "engine/counting", "engine/evaluation", "orchard")
"""The packages that a count of a generated scene depends on, besides the files of `MEASURED_FILES`."""
CAMERA_SEARCH = "engine/scene/sfm/"
"""What only counts from photos alone depend on."""
PHOTO_SEARCH = "engine/counting/photos/"
"""What only counts depend on that search fruit in photos."""
ONLY_ON_CARDS = ("engine/splatting/gpu/", "engine/splatting/training/card_step.py")
"""What runs only on a graphics card; everything is measured on the CPU."""
MEASURED_FILES = (
    "engine/pipeline.py", "engine/reconstruction.py", "engine/training.py", "benchmarks/ladder/stages.py",
    "benchmarks/ladder/frames.py",
)  # fmt: skip
DATA = ("*.wgsl", "*.json", "*.safetensors")


@cache
def code_hash(preset: str, known_cameras: bool, photo_search: bool, own: str = "") -> str:
    """A short hash of the code, the weights and the generator's preset that a count depends on. Comments and docstrings
    are not part of it, nor is what runs only on a graphics card, nor the search for cameras if they are known, nor that
    for fruit in photos without `photo_search`. own: a further file that it depends on."""
    files = _files() | ({own: _meaning(ROOT / own)} if own else {})
    searches = ((CAMERA_SEARCH, not known_cameras), (PHOTO_SEARCH, photo_search))
    unused = (*ONLY_ON_CARDS, *(folder for folder, used in searches if not used))
    files = {name: text for name, text in files.items() if not name.startswith(unused)}
    scene = PRESETS / f"{preset}.toml"
    return text_hash(*files, *files.values(), file_hash(scene) if scene.is_file() else preset)[:12]


@cache
def _files() -> dict[str, str]:
    """{path in the checkout: its meaning}, of code and weights."""
    folders = [ROOT / name for name in MEASURED]
    code = sorted([path for folder in folders for path in folder.rglob("*.py")] + [ROOT / f for f in MEASURED_FILES])
    data = sorted(path for folder in folders for kind in DATA for path in folder.rglob(kind))
    meanings = {path: _meaning(path) for path in code} | {path: file_hash(path) for path in data}
    return {path.relative_to(ROOT).as_posix(): text for path, text in meanings.items()}


def _meaning(path: Path) -> str:
    """The syntax tree of a file without its docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            texts = [each for each in node.body if isinstance(each, ast.Expr) and _is_text(each.value)]
            node.body = [each for each in node.body if each not in texts]
    return ast.dump(tree)


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def commit() -> str:
    """The short name of the checkout's commit, marked if the code of `code_hash` differs from it; `unknown` outside a
    repository. Tables that were written since are no difference."""

    def git(*line: str) -> str:
        return subprocess.run(["git", *line], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        presets = PRESETS.relative_to(ROOT).as_posix()
        changed = git("status", "--porcelain", "--", *MEASURED, *MEASURED_FILES, presets)
        return git("rev-parse", "--short=10", "HEAD") + ("-dirty" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def day() -> str:
    """Today's date, UTC."""
    return datetime.now(UTC).date().isoformat()


def machine() -> str:
    """This computer in words: processor and number of cores."""
    names = Path("/proc/cpuinfo")
    lines = names.read_text(encoding="utf-8", errors="replace").splitlines() if names.is_file() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    cores = usable_cores()
    return f"{model or platform.processor() or platform.machine()}, {cores} core{'s' if cores > 1 else ''}"
