"""Where the extension keeps the Python packages that it installed, and how Blender finds them."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import bpy

EXTENSION = __package__.rpartition(".")[0]
"""The extension's name in this Blender (`bl_ext.….fruitlangs`), or of the package where it is loaded otherwise."""

UNFINISHED = ".part"
"""Ends the name of a folder that is still being filled, or that a killed install left; it is never used."""


def packages_folder() -> Path:
    """The extension's own folder for packages, which outlives its updates; it may not be there yet.

    Each install is a folder of its own in it, named after the Python that it is for.
    """
    try:
        return Path(bpy.utils.extension_path_user(EXTENSION, path="packages"))
    except ValueError:  # not loaded as an extension
        return Path(bpy.utils.user_resource("DATAFILES", path="fruitlangs")) / "packages"


def new_install(folder: Path) -> Path:
    """The name of the next install for this Python: 'cpython-311-1' for the first."""
    last = max(map(_number, installs(folder)), default=0)
    return folder / f"{sys.implementation.cache_tag}-{last + 1}"


def installs(folder: Path) -> list[Path]:
    """The finished installs for this Python, oldest first; Blender copies folders from versions with another one."""
    found = folder.glob(f"{sys.implementation.cache_tag}-*") if folder.is_dir() else []
    return sorted((path for path in found if path.name.rpartition("-")[2].isdigit()), key=_number)


def _number(install: Path) -> int:
    return int(install.name.rpartition("-")[2])


def use_packages(folder: Path | None = None) -> None:
    """Let Python import what was installed in `folder`, else in ours, after all that Blender brings itself."""
    sys.path += [str(path) for path in installs(folder or packages_folder()) if str(path) not in sys.path]
    importlib.invalidate_caches()


def forget_packages() -> None:
    """Undo `use_packages`; what was imported stays imported."""
    own = {str(path) for path in installs(packages_folder())}
    sys.path[:] = [path for path in sys.path if path not in own]
