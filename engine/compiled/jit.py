"""The configuration of Numba: cache of machine code, threads, compiler options.

Kernel files write `from ...compiled.jit import kernel, njit, prange`; nothing else imports numba's decorators.

- Machine code is cached in the user's cache folder, under a name that contains a hash of every source file that
  compiles kernels: Numba itself does not notice when a function that a cached one calls has changed. If that folder
  cannot be written, kernels are compiled again in each process.
- Numba's `workqueue` threads abort the process when two Python threads run kernels at once. `omp` or `tbb` are
  requested, and until one of them is known to be active, `kernel` runs one parallel kernel at a time.
"""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import numba
from numba import prange

from ..user_folders import KERNELS, kernels_folder

__all__ = ["CACHE_FOLDER", "is_all_compiled", "kernel", "mark_compiled", "njit", "prange", "threads"]

_ENGINE = Path(__file__).resolve().parents[1]
_config: Any = numba.config  # its attributes appear at run time


def _sources_hash() -> str:
    """Hash of Numba's version, of this package's name, which machine code holds, and of every engine file that compiles
    kernels."""
    digest = hashlib.sha256(f"{numba.__version__} {__name__}".encode())
    for path in sorted(_ENGINE.rglob("*.py")):
        source = path.read_bytes()
        if b"compiled" in source or b"numba" in source:
            digest.update(path.relative_to(_ENGINE).as_posix().encode() + b"\0" + source)
    return digest.hexdigest()[:16]


def _cache_folder() -> Path | None:
    """A folder that exists and can be written, or None."""
    try:
        folder = kernels_folder() / f"{KERNELS}{_sources_hash()}"
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".writable-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except (OSError, RuntimeError):  # RuntimeError: no home folder is known
        return None
    return folder


CACHE_FOLDER: Path | None = _cache_folder()
"""Folder of machine code between runs; None if no folder can be written."""


def is_all_compiled() -> bool:
    """Whether the cache holds the machine code of all kernels, so that nothing has to be compiled."""
    return CACHE_FOLDER is not None and (CACHE_FOLDER / _marker()).is_file()


def mark_compiled() -> None:
    """Record that all kernels have been compiled."""
    if CACHE_FOLDER is not None:
        (CACHE_FOLDER / _marker()).touch()


def _marker() -> str:
    """Name of the file that records it: Numba caches machine code for one Python and one folder of sources."""
    return "complete-" + hashlib.sha256(f"{sys.implementation.cache_tag} {_ENGINE}".encode()).hexdigest()[:16]


@contextmanager
def _use_cache_folder() -> Iterator[None]:
    """Use our cache folder while a function is declared; other users of Numba in the process keep theirs."""
    before = _config.CACHE_DIR
    _config.CACHE_DIR = str(CACHE_FOLDER) if CACHE_FOLDER is not None else before
    try:
        yield
    finally:
        _config.CACHE_DIR = before


def _prefer_safe_threads() -> None:
    """Request OpenMP or TBB unless the user chose a layer or one runs already."""
    if _config.THREADING_LAYER != "default":
        return
    for layer, module in (("omp", "omppool"), ("tbb", "tbbpool")):
        try:
            __import__(f"numba.np.ufunc.{module}")
        except ImportError:
            continue
        _config.THREADING_LAYER = layer
        return


_prefer_safe_threads()


def njit(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """`numba.njit` with this project's options: fast float32 arithmetic, no GIL, cached machine code."""
    if function is None:
        return lambda wrapped: njit(wrapped, **options)
    defaults: dict[str, Any] = {
        "fastmath": True,
        "error_model": "numpy",
        "nogil": True,
        "cache": CACHE_FOLDER is not None,
        # Whether LLVM inlines a callee must not depend on whether it comes from the cache: rounding would differ.
        "forceinline": not options.get("parallel", False),
    }
    with _use_cache_folder():
        try:
            return numba.njit(**(defaults | options))(function)
        except RuntimeError:  # Numba finds no file of the function: it came from a zip or a console
            return numba.njit(**(defaults | options | {"cache": False}))(function)


_one_at_a_time = threading.RLock()


def _threads_are_safe() -> bool:
    try:
        return numba.threading_layer() in ("omp", "tbb")
    except ValueError:  # no parallel kernel has run yet
        return False


def kernel(function: Callable[..., Any] | None = None, **options: Any) -> Any:
    """A parallel kernel called from Python; loops over `prange` run on Numba's threads. options: those of `njit`."""
    if function is None:
        return lambda wrapped: kernel(wrapped, **options)
    compiled = njit(function, parallel=True, **options)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        if _threads_are_safe():
            return compiled(*arguments)
        with _one_at_a_time:
            return compiled(*arguments)

    return call


def threads() -> int:
    """Number of threads of parallel kernels."""
    return int(numba.get_num_threads())
