"""Stage caches: the output of each stage is stored in a folder named by a hash of everything it depends on."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from .files import files_hash, text_hash

_ENGINE = Path(__file__).resolve().parents[1]
_KINDS = ("*.py", "*.wgsl", "*.json", "*.safetensors")
"""Files of sources, fitted numbers and weights."""
_AROUND_COUNTS = ("block", "evaluation", "photo_check")
"""Packages on which no count of a scene depends."""


@cache
def _code_hash(room: str) -> str:
    """Hash of the sources, fitted numbers and weights of a package, or of a module's source, so that changed code never
    uses an older output.

    Raises:
        ValueError: there is neither.
    """
    module = _ENGINE / f"{room}.py"
    files = [module] if module.is_file() else _code(room)
    if not files:
        raise ValueError(f"engine/{room} has no code")
    return files_hash(files, _ENGINE)


@cache
def program_key() -> str:
    """A short name for the code, fitted numbers and weights on which the count of a scene depends."""
    around = [_ENGINE / package for package in _AROUND_COUNTS]
    files = [path for path in _code("") if not any(path.is_relative_to(folder) for folder in around)]
    return files_hash(files, _ENGINE)[:16]


def _code(room: str) -> list[Path]:
    """The files of a package, sorted."""
    return sorted(path for kind in _KINDS for path in (_ENGINE / room).rglob(kind))


def stage_key(rooms: tuple[str, ...], *inputs: Any) -> str:
    """A short name for the output of a stage: hash of all code that it runs, given by packages and modules
    (`rooms`), and of its inputs (texts, configs and mappings)."""
    return text_hash(*(_code_hash(room) for room in rooms), *map(_text, inputs))[:16]


def _text(value: Any) -> str:
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, Mapping):
        return json.dumps(value, sort_keys=True)
    return str(value)
