"""Origin of a result: versions, and the date and seconds, which are all that differs between equal runs."""

from __future__ import annotations

import importlib
import platform
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

_PACKAGES = ("numba", "numpy", "pycolmap", "scikit-image", "scikit-learn", "scipy", "torch")


def versions() -> dict[str, str]:
    """Versions of FruitLangs, of Python and of the numerical packages."""
    # By relative name: inside Blender the root package is called bl_ext.….fruitlangs and is not installed.
    root = importlib.import_module("...", __package__)
    found = {"fruitlangs": root.__version__, "python": platform.python_version(), "machine": platform.machine()}
    for package in _PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            # Inside Blender a package may lack its metadata; use the imported one.
            found[package] = "unknown"
    return found


def run_stamp(seconds: Mapping[str, float]) -> dict[str, Any]:
    """The only parts of a result that differ between equal runs."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": {stage: round(value, 2) for stage, value in seconds.items()},
    }
