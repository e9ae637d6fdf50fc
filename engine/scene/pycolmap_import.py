"""Imports pycolmap when it is first needed; nothing else imports it directly."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any


@cache
def colmap_library() -> Any:
    """The module `pycolmap`, without its handler for SIGTERM.

    pycolmap installs Google's failure handlers, which react to a SIGTERM (how a cluster or a user stops a job) with a
    stack trace and an abort. Only the main thread can restore the handler; in another thread it stays as pycolmap set
    it.
    """
    before = signal.getsignal(signal.SIGTERM)
    with allow_another_gflags():
        import pycolmap

    try:
        signal.signal(signal.SIGTERM, before if before is not None else signal.SIG_DFL)
    except ValueError:
        return pycolmap
    return pycolmap


@contextmanager
def allow_another_gflags() -> Iterator[None]:
    """Allow the import of pycolmap if the program has loaded the system's gflags, as a distribution's Blender may have.

    gflags ends the whole program if a second copy of it declares the same flags. The function that ends it is a
    variable of the library: while pycolmap's copy declares its flags, the function does nothing, and the output of
    gflags is dropped. These flags are never read.
    """
    loaded = find_loaded_library("libgflags.so")
    if loaded is None:
        yield
        return
    end = ctypes.c_void_p.in_dll(ctypes.CDLL(str(loaded)), "_ZN6google15gflags_exitfuncE")
    go_on = ctypes.CFUNCTYPE(None, ctypes.c_int)(lambda code: None)
    before, errors, nowhere = end.value, os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        end.value = ctypes.cast(go_on, ctypes.c_void_p).value
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(errors, 2)
        os.close(errors)
        os.close(nowhere)
        end.value = before


def find_loaded_library(name: str, maps: Path = Path("/proc/self/maps")) -> Path | None:
    """Find the file of a shared library that this process has loaded, by the start of its name; None if it has not, or
    if the system does not say (only Linux has this conflict)."""
    try:
        lines = maps.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return None
    paths = (Path(line.split(maxsplit=5)[5]) for line in lines if line.count(" ") >= 5 and "/" in line)
    return next((path for path in paths if path.name.startswith(name)), None)
