"""A part of the engine in a Python process of its own: libraries that cannot be interrupted, or that may abort."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import IO

from .errors import FruitLangsError
from .progress import Progress, silent

ROOT = Path(__file__).resolve().parents[1]
POLL_SECONDS = 0.25
"""So often `progress` is called, and may cancel, while the child says nothing."""

# The package may be a checkout or a Blender extension, under another name each time: the child loads it as fruitlangs.
_BOOT = """
import importlib, importlib.util, sys
root, module, *arguments = sys.argv[1:]
spec = importlib.util.spec_from_file_location("fruitlangs", root + "/__init__.py", submodule_search_locations=[root])
sys.modules["fruitlangs"] = importlib.util.module_from_spec(spec)
importlib.import_module("fruitlangs.engine." + module).main(arguments)
"""


class ChildError(FruitLangsError):
    """The child failed; the message is its own last words."""


def run_child(module: str, arguments: Sequence[str], log: Path, progress: Progress = silent) -> None:
    """Run `main(arguments)` of an engine module ("scene.sfm.mapping") in a new process until it ends.

    The child reports by `tell` and fails by `give_up`; all else that it or its libraries write to stderr goes to `log`.
    Whatever `progress` raises ends the child at once, and the child ends itself when this process dies.

    Raises:
        ChildError: it gave up, crashed, or could not be started.
    """
    command = [sys.executable, "-c", _BOOT, str(ROOT), module, *arguments]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    try:
        with log.open("wb") as errors:
            child = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, env=environment, encoding="utf-8"
            )
    except OSError as error:
        raise ChildError(f"{sys.executable} cannot be started ({error.strerror or error})") from error
    try:
        last_words = _relay(child, progress)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                pipe.close()
    if child.returncode or last_words:
        raise ChildError(last_words or f"it ended with code {child.returncode}")


def _relay(child: subprocess.Popen[str], progress: Progress) -> str:
    """Report what the child tells until it ends; returns what it gave up with, or nothing."""
    lines: SimpleQueue[str | None] = SimpleQueue()
    assert child.stdout is not None
    Thread(target=_collect, args=(child.stdout, lines), daemon=True).start()
    fraction, message, last_words = 0.0, "starting", ""
    while True:
        progress(fraction, message)
        try:
            line = lines.get(timeout=POLL_SECONDS)
        except Empty:
            continue
        if line is None:
            child.wait()
            return last_words
        kind, _, text = line.rstrip("\n").partition("\t")
        if kind == "error":
            last_words = text
        elif kind == "at":
            number, _, message = text.partition("\t")
            fraction = float(number)


def _collect(stream: IO[str], lines: SimpleQueue[str | None]) -> None:
    for line in stream:
        lines.put(line)
    lines.put(None)


def tell(fraction: float, message: str) -> None:
    """In the child: a `Progress` that reports to the parent."""
    print(f"at\t{fraction:.6f}\t{message}", flush=True)


def give_up(reason: str) -> None:
    """In the child: end with one line that says why."""
    print(f"error\t{' '.join(reason.split())}", flush=True)
    sys.exit(1)


def end_with_parent() -> None:
    """In the child: end as soon as the parent has, however it did."""

    def wait() -> None:
        os.read(0, 1)  # not sys.stdin, whose lock would abort this process at its own end
        os._exit(1)

    Thread(target=wait, daemon=True).start()
