"""Runs of the orchard generator in a process of its own, and a reader of what it leaves."""

from __future__ import annotations

import importlib.util
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "make_orchard.py"
TINY = "--fruits 12 --fallen 1 --leaves 200 --views 3 --rings 1 --width 64 --height 48 --samples 1 --points 300"
HAS_BPY = importlib.util.find_spec("bpy") is not None
needs_bpy = pytest.mark.skipif(not HAS_BPY, reason="the bpy module is not installed")


def make(out: Path, *flags: str) -> subprocess.CompletedProcess[str]:
    """Run the script in a process of its own: Blender's module and pytest end apart."""
    command = [sys.executable, str(SCRIPT), "--out", str(out), *TINY.split(), *flags]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


def read_grey(path: Path) -> np.ndarray:
    """The values of a PNG that `write_grey` wrote, by the specification rather than by our own code."""
    data = path.read_bytes()
    width, height, depth = struct.unpack(">IIB", data[16:25])
    start = data.index(b"IDAT")
    (length,) = struct.unpack(">I", data[start - 4 : start])
    raw = zlib.decompress(data[start + 4 : start + 4 + length])
    rows = np.frombuffer(raw, dtype=np.uint8).reshape(height, 1 + width * depth // 8)[:, 1:]
    return rows.copy().view(">u2" if depth == 16 else "u1").reshape(height, width)
