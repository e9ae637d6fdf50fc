"""Tests run from a bare checkout: the package is importable as `fruitlangs` without an install."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "scripts"))

import _checkout  # noqa: F401
