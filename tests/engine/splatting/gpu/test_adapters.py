"""The choice of a graphics card, and errors that say what was found."""

from __future__ import annotations

import builtins
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from fruitlangs.engine.errors import GpuError
from fruitlangs.engine.splatting.gpu import adapters
from fruitlangs.engine.splatting.gpu.adapters import LIMITS, Adapter, choose_adapter, find_adapters

ROOT = Path(__file__).resolve().parents[4]
ENOUGH = {**LIMITS, "max-buffer-size": 1 << 30, "max-storage-buffer-binding-size": 1 << 28}


def made(name: str, *, software: bool = False, **limits: int) -> Adapter:
    handle = SimpleNamespace(limits={**ENOUGH, **{key.replace("_", "-"): value for key, value in limits.items()}})
    return Adapter(name, "driver 1", "Vulkan", software, handle)


RADEON, OLD = made("Radeon 780M"), made("Old Card", max_compute_workgroup_storage_size=16384)
LAVAPIPE = made("llvmpipe", software=True)


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> list[Adapter]:
    found: list[Adapter] = []
    monkeypatch.setattr(adapters, "find_adapters", lambda: found)
    return found


def test_auto_takes_a_real_card_that_suffices_and_never_software(there: list[Adapter]) -> None:
    assert choose_adapter("auto") is None
    there[:] = [OLD, LAVAPIPE]
    assert choose_adapter("auto") is None
    there[:] = [OLD, RADEON, LAVAPIPE]
    assert choose_adapter("auto") is choose_adapter("gpu") is RADEON
    assert choose_adapter("cpu") is None


def test_a_name_takes_any_card_also_a_software_one(there: list[Adapter]) -> None:
    there[:] = [RADEON, LAVAPIPE]
    assert choose_adapter("LLVM") is LAVAPIPE
    assert choose_adapter("780m") is RADEON


def test_a_missing_card_is_an_error_that_lists_what_was_found(there: list[Adapter]) -> None:
    with pytest.raises(
        GpuError, match=r"No graphics card is found\. Found: none\. Install the driver of the card, or train with"
    ):
        choose_adapter("gpu")
    there[:] = [OLD, LAVAPIPE]
    with pytest.raises(GpuError, match=r"Old Card \(max-compute-workgroup-storage-size is 16384, 24576 are needed\)"):
        choose_adapter("gpu")
    with pytest.raises(GpuError, match=r"No graphics card is named 'RTX'. Found: .*llvmpipe \(software, Vulkan\)"):
        choose_adapter("RTX")


def test_without_wgpu_auto_is_the_cpu_and_gpu_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name == "wgpu":
            raise ImportError(name)
        return usual(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    assert choose_adapter("auto") is None
    with pytest.raises(GpuError, match=r"The package wgpu.* pip install wgpu"):
        choose_adapter("gpu")


def test_a_driver_that_fails_is_an_error_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Any) -> list[Any]:
        raise RuntimeError("no Vulkan library")

    monkeypatch.setattr(adapters, "_list_adapters", fail)
    with pytest.raises(GpuError, match=r"cannot be listed \(no Vulkan library\)"):
        find_adapters()
    assert choose_adapter("auto") is None


def test_a_card_without_enough_limits_is_not_opened() -> None:
    with pytest.raises(GpuError, match="Old Card cannot be used: max-compute-workgroup-storage-size is 16384"):
        OLD.request()


def test_a_card_without_enough_limits_is_an_error_if_it_was_asked_for(there: list[Adapter]) -> None:
    there[:] = [OLD]
    with pytest.raises(GpuError, match="Old Card cannot be used: max-compute-workgroup-storage-size is 16384"):
        choose_adapter("old")


def test_the_command_line_says_before_anything_else_that_a_card_is_missing(tmp_path: Path) -> None:
    command = [sys.executable, ROOT / "scripts" / "count_fruit.py", ROOT / "examples" / "orchard_tree"]
    options = ["--prompt", "apple", "--out", tmp_path / "out", "--train.device", "no such card"]
    done = subprocess.run([str(part) for part in (*command, *options)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    [line] = [line for line in done.stderr.splitlines() if line.startswith("error: No")]
    assert line.startswith("error: No graphics card is named 'no such card'. Found: ")
    assert "Traceback" not in done.stderr
    assert not list((tmp_path / "out").glob("*.ply"))
