"""Runs a part of the engine in its own Python process: for libraries that cannot be interrupted or that may abort."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import IO

from .errors import FruitLangsError
from .progress import Progress, silent

ROOT = Path(__file__).resolve().parents[1]
POLL_SECONDS = 0.25
"""Seconds between calls of `progress`, which may cancel, while the child is silent."""

_PACKAGE = __name__.removesuffix(".engine.child_process")
"""`fruitlangs`, or `bl_ext.….fruitlangs` in Blender. The child loads it under the same name, because machine code that
it leaves in Numba's cache holds the names of modules."""
_BOOT = """
import importlib, importlib.util, sys, types
root, package, module, *arguments = sys.argv[1:]
parents = package.split(".")[:-1]
for count in range(1, len(parents) + 1):
    sys.modules[".".join(parents[:count])] = types.ModuleType(parents[count - 1])
spec = importlib.util.spec_from_file_location(package, root + "/__init__.py", submodule_search_locations=[root])
sys.modules[package] = importlib.util.module_from_spec(spec)
importlib.import_module(package + ".engine." + module).main(arguments)
"""


def usable_cores() -> int:
    """The cores that this process may use, which a batch system or container can limit."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class ChildError(FruitLangsError):
    """The child failed; the message is the last that it wrote."""


def start_child(module: str, arguments: Sequence[str], *, errors: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start `main(arguments)` of an engine module ("scene.sfm.mapping") in a new process, with pipes to its standard
    input and output. errors: the file to which it writes everything else.

    Raises:
        ChildError: it could not be started.
    """
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
        "PYTHONIOENCODING": "utf-8:backslashreplace",
    }
    try:
        return subprocess.Popen(
            [sys.executable, "-c", _BOOT, str(ROOT), _PACKAGE, module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise ChildError(f"{sys.executable} cannot be started ({error.strerror or error})") from error


def run_child(module: str, arguments: Sequence[str], log: Path, progress: Progress = silent) -> None:
    """Run `main(arguments)` of an engine module ("scene.sfm.mapping") in a new process until it ends.

    The child reports with `tell` and fails with `give_up`; everything else written to stderr goes to `log`. An
    exception from `progress` ends the child at once, and the child ends if this process dies.

    Raises:
        ChildError: it gave up, crashed, or could not be started.
    """
    try:
        with log.open("wb") as errors:
            child = start_child(module, arguments, errors=errors)
    except OSError as error:
        raise ChildError(f"{log} cannot be written ({error.strerror or error})") from error
    try:
        last_words = _relay(child, progress)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
        assert child.stdin is not None
        child.stdin.close()
    if child.returncode or last_words:
        raise ChildError(last_words or f"it ended with code {child.returncode}{_last_line(log)}")


def _last_line(log: Path) -> str:
    """The end of an error message: where the log is, and its last line."""
    written = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f". The last line of {log} is: {written[-1].strip()}" if written else f". Its log {log} is empty"


def _relay(child: subprocess.Popen[bytes], progress: Progress) -> str:
    """Report the child's progress until it ends; returns its error message, or an empty text."""
    lines: SimpleQueue[str | None] = SimpleQueue()
    assert child.stdout is not None
    # Libraries and Windows print in other encodings.
    stream = io.TextIOWrapper(child.stdout, encoding="utf-8", errors="replace")
    Thread(target=_collect, args=(stream, lines), daemon=True).start()
    fraction, message, last_words = 0.0, "starting", ""
    while True:
        progress(fraction, message)
        try:
            line = lines.get(timeout=POLL_SECONDS)
        except Empty:
            if child.poll() is None:
                continue
            line = None  # it ended, although a process that it started may keep its output open
        if line is None:
            child.wait()
            return last_words
        kind, _, text = line.rstrip("\n").partition("\t")
        if kind == "error":
            last_words = text
        elif kind == "at":
            number, _, message = text.partition("\t")
            with suppress(ValueError):  # a line of another program
                fraction = float(number)


def _collect(stream: IO[str], lines: SimpleQueue[str | None]) -> None:
    """Pass lines on until the stream ends, then close it; another thread would have to wait for that."""
    try:
        with stream:
            for line in stream:
                lines.put(line)
    finally:
        lines.put(None)


def tell(fraction: float, message: str) -> None:
    """In the child: a `Progress` that reports to the parent."""
    print(f"at\t{fraction:.6f}\t{message}", flush=True)


def give_up(reason: str) -> None:
    """In the child: end with a one-line reason."""
    print(f"error\t{' '.join(reason.split())}", flush=True)
    sys.exit(1)


def end_with_parent() -> None:
    """In the child: end as soon as the parent has ended, for whatever reason."""

    def wait() -> None:
        os.read(0, 1)  # not sys.stdin, whose lock would abort this process at its own end
        os._exit(1)

    Thread(target=wait, daemon=True).start()
