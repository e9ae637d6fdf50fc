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

ROOT = Path(__file__).resolve().parents[2]
MEASURED = ("engine/scene", "engine/splatting", "engine/language", "engine/counting", "engine/evaluation", "orchard")
"""The packages that a count of a generated scene depends on, besides the files of `MEASURED_FILES`."""
MEASURED_FILES = (
    "engine/pipeline.py", "engine/reconstruction.py", "engine/training.py", "benchmarks/ladder/stages.py",
    "benchmarks/ladder/frames.py",
)  # fmt: skip
DATA = ("*.wgsl", "*.json", "*.safetensors")


@cache
def code_hash() -> str:
    """A short hash of the code and the weights that a count depends on. Comments and docstrings are not part of it."""
    folders = [ROOT / name for name in MEASURED]
    code = sorted([path for folder in folders for path in folder.rglob("*.py")] + [ROOT / f for f in MEASURED_FILES])
    data = sorted(path for folder in folders for kind in DATA for path in folder.rglob(kind))
    names = [path.relative_to(ROOT).as_posix() for path in (*code, *data)]
    return text_hash(*names, *map(_meaning, code), *map(file_hash, data))[:12]


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
        changed = git("status", "--porcelain", "--", *MEASURED, *MEASURED_FILES)
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
    return f"{model or platform.processor() or platform.machine()}, {usable_cores()} cores"
