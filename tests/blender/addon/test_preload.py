"""Large libraries are in memory before Python imports them, which would stop the window."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from fruitlangs.operators.jobs import preload
from fruitlangs.operators.jobs.preload import LARGE

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
import _checkout
from fruitlangs.operators.jobs.preload import preload_libraries
before = set(sys.modules)
preload_libraries()
print(*(set(sys.modules) - before))
print(open("/proc/self/maps").read())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="what is in memory is read from Linux's /proc")
def test_libraries_are_loaded_without_importing_their_packages():
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(ROOT / "scripts")], capture_output=True, text=True, check=True
    )
    imported, maps = done.stdout.split("\n", 1)
    assert not set(LARGE) & set(imported.split())
    for package, library in LARGE.items():
        folder = Path(importlib.util.find_spec(package).origin).parent
        assert str(folder.resolve() / library) in maps


def test_pycolmap_is_loaded_so_that_another_gflags_does_not_end_blender(monkeypatch):
    """gflags ends the program where a second copy declares the same flags, as a distribution's Blender may hold."""
    guarded, loaded = [], []

    @contextmanager
    def guard():
        guarded.append(True)
        yield
        guarded.pop()

    monkeypatch.setattr(preload, "allow_another_gflags", guard)
    monkeypatch.setattr(preload, "_preload", lambda name, _: loaded.append((name, bool(guarded))))
    monkeypatch.setattr(preload, "sys", SimpleNamespace(modules={}))
    preload.preload_libraries()
    assert loaded == [(name, name == "pycolmap") for name in LARGE]
