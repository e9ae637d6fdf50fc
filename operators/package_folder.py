"""The folder of the Python packages that the extension installed, and how Python finds them."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import bpy

EXTENSION = __package__.rpartition(".")[0]
"""The extension's name in this Blender (`bl_ext.….fruitlangs`), or the name of the package if it is not an
extension."""

UNFINISHED = ".part"
"""Suffix of a folder that is being filled, or that a killed install left; it is never used."""

CUDA = "-cuda"
"""In the name of an install that holds PyTorch for NVIDIA cards."""


def packages_folder() -> Path:
    """The extension's own folder for packages, which survives its updates; it may not exist yet.

    Each install is a folder in it, named after its Python version and, with PyTorch for NVIDIA cards, `CUDA`.
    """
    try:
        return Path(bpy.utils.extension_path_user(EXTENSION, path="packages"))
    except ValueError:  # not loaded as an extension
        return Path(bpy.utils.user_resource("DATAFILES", path="fruitlangs")) / "packages"


def name_new_install(folder: Path, *, cuda: bool = False) -> Path:
    """Name the next install for this Python: 'cpython-311-1' for the first; 'cpython-311-cuda-1'."""
    last = max(map(_parse_number, list_installs(folder)), default=0)
    return folder / f"{sys.implementation.cache_tag}{CUDA if cuda else ''}-{last + 1}"


def list_installs(folder: Path) -> list[Path]:
    """List the finished installs for this Python, oldest first; Blender also copies folders of versions with another
    one."""
    found = folder.glob(f"{sys.implementation.cache_tag}-*") if folder.is_dir() else []
    return sorted((path for path in found if path.name.rpartition("-")[2].isdigit()), key=_parse_number)


def _parse_number(install: Path) -> int:
    return int(install.name.rpartition("-")[2])


def use_packages(folder: Path | None = None) -> None:
    """Let Python import packages from `folder`, else from ours, after all that Blender has; PyTorch for NVIDIA cards
    before it."""
    for path in list_installs(folder or packages_folder()):
        if str(path) not in sys.path:
            sys.path.insert(0 if CUDA in path.name else len(sys.path), str(path))
    importlib.invalidate_caches()


def forget_packages() -> None:
    """Undo `use_packages`; what was imported stays imported."""
    own = {str(path) for path in list_installs(packages_folder())}
    sys.path[:] = [path for path in sys.path if path not in own]
