"""Stage caches: each stage's output lives in a folder named after everything that determines it."""

from __future__ import annotations

import json
from dataclasses import asdict, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from .files import files_hash, text_hash

_ENGINE = Path(__file__).resolve().parent


@cache
def _code_hash(room: str) -> str:
    """Hash of a room's sources and fitted numbers: what is changed must not answer with what an older one left."""
    return files_hash(sorted(path for kind in ("*.py", "*.json") for path in (_ENGINE / room).rglob(kind)), _ENGINE)


def stage_key(rooms: tuple[str, ...], *inputs: Any) -> str:
    """A short name of a stage's output: hash of the code of its `rooms` and of its inputs (texts and configs)."""
    return text_hash(*(_code_hash(room) for room in rooms), *map(_text, inputs))[:16]


def _text(value: Any) -> str:
    if is_dataclass(value) and not isinstance(value, type):
        return json.dumps(asdict(value), sort_keys=True)
    return str(value)
