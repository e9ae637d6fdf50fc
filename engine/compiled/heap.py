"""The C library's heap, which keeps freed memory for later."""

from __future__ import annotations

import ctypes
import sys


def release_freed() -> None:
    """Return freed memory to the operating system. Without it, glibc keeps freed arrays of up to 32 MB: 1.9 GB after
    training on 60 photos of 1600×1200. Other systems return it themselves."""
    if sys.platform == "linux" and (trim := getattr(ctypes.CDLL(None), "malloc_trim", None)) is not None:
        trim(0)
