"""Loads large libraries without blocking the window.

Python holds its global lock while it loads an extension module, most of a second for PyTorch's; a foreign function call
releases the lock. So a library is loaded by the system's own call first, and the import then finds it loaded.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from contextlib import nullcontext, suppress
from importlib.machinery import PathFinder

from ...engine.scene.pycolmap_import import allow_another_gflags

LARGE = {"torch": "_C", "pycolmap": "_core", "llvmlite": "binding/libllvmlite"}
"""{package: its library, without suffix} of those that take a quarter of a second or more."""


def preload_libraries() -> None:
    """Load the large libraries that are installed and not loaded yet; called in a thread. Failures are reported by the
    later import, in more detail."""
    if os.name != "posix":
        return
    for name, library in LARGE.items():
        if name not in sys.modules:
            with allow_another_gflags() if name == "pycolmap" else nullcontext():
                _preload(name, library)


def _preload(name: str, library: str) -> None:
    package = importlib.util.find_spec(name)
    folder, _, stem = library.rpartition("/")
    places = [os.path.join(place, folder) for place in (package and package.submodule_search_locations) or ()]
    extension = PathFinder.find_spec(stem, places)
    if not extension or not extension.origin:
        return
    with suppress(OSError, AttributeError):
        load = ctypes.CDLL(None).dlopen
        load.restype, load.argtypes = ctypes.c_void_p, [ctypes.c_char_p, ctypes.c_int]
        load(os.fsencode(extension.origin), os.RTLD_NOW)
