"""pycolmap, imported when first needed and in this one place."""

from __future__ import annotations

import signal
from functools import cache
from typing import Any


@cache
def colmap_library() -> Any:
    """The module `pycolmap`, with SIGTERM left as it was.

    pycolmap installs Google's failure handlers, which answer a SIGTERM (how a cluster or a person stops a job) with a
    stack trace and an abort. Only the main thread can give the signal back; in another it stays as pycolmap has it.
    """
    before = signal.getsignal(signal.SIGTERM)
    import pycolmap

    try:
        signal.signal(signal.SIGTERM, before if before is not None else signal.SIG_DFL)
    except ValueError:
        return pycolmap
    return pycolmap
