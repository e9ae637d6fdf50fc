"""Wheels that do not fit a Blender, or one another, are named before a zip is built."""

from __future__ import annotations

from pathlib import Path

import pytest
from _wheel_check import find_misfits
from tiny_wheels import make_wheel

from fruitlangs.operators.packages.package_versions import versions_for

LINUX = ("manylinux_2_28_x86_64",)


def checked(folder: Path, python: str = "3.11", numpy: str = "1.26.4", system: str = "linux") -> list[str]:
    platforms = {"linux": LINUX, "win32": ("win_amd64",), "darwin": ("macosx_14_0_arm64",)}[system]
    return find_misfits(sorted(folder.glob("*.whl")), python=python, numpy=numpy, system=system, platforms=platforms)


def test_a_requirement_is_met_by_another_wheel_or_by_blenders_numpy(tmp_path: Path) -> None:
    make_wheel(tmp_path, "grafting", needs=("rootstock>=1.0", "numpy<2"))
    make_wheel(tmp_path, "rootstock")
    assert checked(tmp_path) == []
    assert checked(tmp_path, numpy="2.3.4") == ["grafting-1.0-py3-none-any.whl needs numpy<2 (there is 2.3.4)"]


def test_a_requirement_that_nothing_meets_is_named(tmp_path: Path) -> None:
    make_wheel(tmp_path, "grafting", needs=("rootstock>=2.0",))
    assert checked(tmp_path) == ["grafting-1.0-py3-none-any.whl needs rootstock>=2.0 (missing)"]
    make_wheel(tmp_path, "rootstock")
    assert checked(tmp_path) == ["grafting-1.0-py3-none-any.whl needs rootstock>=2.0 (there is 1.0)"]


@pytest.mark.parametrize(
    ("need", "system"),
    [
        ("knife; sys_platform == 'darwin'", "darwin"),
        ("knife; platform_system == 'Windows'", "win32"),
        ("knife; platform_machine == 'x86_64'", "linux"),
    ],
)
def test_a_requirement_of_one_system_holds_only_there(tmp_path: Path, need: str, system: str) -> None:
    make_wheel(tmp_path, "grafting", needs=(need,))
    needing = [each for each in ("linux", "win32", "darwin") if checked(tmp_path, system=each)]
    assert needing == [system]


def test_optional_requirements_are_not_asked_for(tmp_path: Path) -> None:
    make_wheel(tmp_path, "grafting", needs=("knife; extra == 'sharp'",))
    assert checked(tmp_path) == []


@pytest.mark.parametrize(
    ("tags", "system", "fits"),
    [
        ("cp311-cp311-manylinux_2_28_x86_64", "linux", True),
        ("cp39-abi3-manylinux_2_28_x86_64", "linux", True),
        ("cp313-cp313-manylinux_2_28_x86_64", "linux", False),
        ("cp311-cp311-win_amd64", "linux", False),
        ("cp311-cp311-macosx_11_0_arm64", "darwin", True),
        ("cp311-cp311-macosx_15_0_arm64", "darwin", False),
    ],
)
def test_a_wheel_is_for_its_python_and_platform(tmp_path: Path, tags: str, system: str, fits: bool) -> None:
    make_wheel(tmp_path, "grafting")
    wheel = tmp_path / "grafting-1.0-py3-none-any.whl"
    wheel.rename(tmp_path / f"grafting-1.0-{tags}.whl")
    assert checked(tmp_path, system=system) == (
        [] if fits else [f"grafting-1.0-{tags}.whl is for another Python or platform"]
    )


def test_graphics_cards_of_macs_get_the_package_that_wgpu_needs_there() -> None:
    assert "rubicon-objc" in versions_for("1.26.4", "darwin")
    assert "rubicon-objc" not in versions_for("1.26.4", "linux")
