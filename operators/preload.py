"""PyTorch's library loaded so that the window lives on meanwhile.

Python holds its one lock while it loads an extension module, most of a second for PyTorch's; a foreign call gives the
lock up. So the library is loaded by the system's own call first, and importing it then finds it there.
"""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from contextlib import suppress
from importlib.machinery import PathFinder


def preload_torch() -> None:
    """Load it unless it is loaded, or is not installed; to be called in a thread. What fails here fails at the import,
    which tells more."""
    if "torch" in sys.modules or os.name != "posix":
        return
    package = importlib.util.find_spec("torch")
    extension = package and PathFinder.find_spec("_C", package.submodule_search_locations)
    if not extension or not extension.origin:
        return
    with suppress(OSError, AttributeError):
        load = ctypes.CDLL(None).dlopen
        load.restype, load.argtypes = ctypes.c_void_p, [ctypes.c_char_p, ctypes.c_int]
        load(os.fsencode(extension.origin), os.RTLD_NOW)
