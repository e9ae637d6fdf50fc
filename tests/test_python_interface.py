"""The names that `import fruitlangs` offers, and the examples that use them."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import fruitlangs

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_at_most_eight_names_are_exported_and_each_has_a_docstring() -> None:
    assert len(fruitlangs.__all__) <= 8
    assert [name for name in fruitlangs.__all__ if not getattr(fruitlangs, name).__doc__] == []


def test_dir_lists_the_exported_names() -> None:
    assert set(fruitlangs.__all__) <= set(dir(fruitlangs))


def test_a_name_that_is_not_exported_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'count_fruit'"):
        fruitlangs.count_fruit  # noqa: B018


def test_importing_the_package_imports_neither_torch_nor_blender(tmp_path: Path) -> None:
    (tmp_path / "fruitlangs").symlink_to(ROOT)
    code = "import sys, fruitlangs; print([name for name in ('torch', 'numpy', 'bpy') if name in sys.modules])"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert done.stdout.strip() == "[]"


def test_the_example_counts_a_tree_and_prints_its_fruit(
    counted_balls: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example("count_tree").main(counted_balls.out, tmp_path / "out")
    first, *fruit = capsys.readouterr().out.splitlines()
    assert first.startswith("5 visible apples")
    assert len(fruit) == 5


def test_the_example_counts_five_prompts_and_plots_them(
    counted_balls: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example("query_prompts").main(counted_balls.out, tmp_path / "out")
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["apple", "red apple", "green apple", "orange", "fruit"]
    assert (tmp_path / "out" / "prompts.png").read_bytes().startswith(b"\x89PNG")


def test_the_example_counts_in_gaussians_of_another_program(
    balls: Path, counted_balls: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example("count_gaussians").main(balls, counted_balls.out / "gaussians.ply", tmp_path / "out")
    assert f"in {len(counted_balls.gaussians.means)} Gaussians" in capsys.readouterr().out
