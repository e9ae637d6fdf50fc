"""Keeps a folder for one process at a time, also among containers and computers that share it."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from filelock import BaseFileLock, FileLock, SoftFileLock, Timeout

from ..errors import OutputError

PATIENCE = 5.0
"""Seconds to wait for a process that is about to end."""
_LOCKS: tuple[tuple[type[BaseFileLock], str], ...] = ((FileLock, "lock"), (SoftFileLock, "lock-file"))
_OWNER = "lock-owner.txt"
_NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.ENOLCK)


@contextmanager
def hold_lock(folder: Path, shown: Path) -> Iterator[None]:
    """Hold the lock of `folder`, which exists, until the block ends; errors call it `shown`.

    The operating system releases the lock of a process that ended in any way. On a file system without locks, a file
    stands for it, and the next process on the same computer takes over what a dead one left.

    Raises:
        OutputError: another process holds it, which the message names, or the folder cannot be written.
    """
    try:
        lock = _acquire(folder)
        started = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        (folder / _OWNER).write_text(f"process {os.getpid()} on {socket.gethostname()} since {started}", "utf-8")
    except Timeout as error:
        raise OutputError(
            f"{shown} is in use by {_owner(folder)}. Wait until that run has ended, or choose another --out"
        ) from error
    except OSError as error:
        raise OutputError(f"{shown} cannot be locked ({error.strerror or error}). Choose another --out") from error
    try:
        yield
    finally:
        lock.release()


def _acquire(folder: Path) -> BaseFileLock:
    for kind, name in _LOCKS:
        lock = kind(folder / name, timeout=PATIENCE)
        try:
            lock.acquire()
        except OSError as error:
            if isinstance(error, Timeout) or error.errno not in _NO_LOCKS:
                raise
        else:
            return lock
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))


def _owner(folder: Path) -> str:
    try:
        return (folder / _OWNER).read_text("utf-8")
    except (OSError, UnicodeDecodeError):
        return "another process"
