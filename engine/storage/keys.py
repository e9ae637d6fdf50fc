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


@cache
def _code_hash(room: str) -> str:
    """Hash of the sources, fitted numbers and weights of a package, or of a module's source, so that changed code never
    uses an older output.

    Raises:
        ValueError: there is neither.
    """
    module, kinds = _ENGINE / f"{room}.py", ("*.py", "*.wgsl", "*.json", "*.safetensors")
    files = [module] if module.is_file() else sorted(path for kind in kinds for path in (_ENGINE / room).rglob(kind))
    if not files:
        raise ValueError(f"engine/{room} has no code")
    return files_hash(files, _ENGINE)


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
