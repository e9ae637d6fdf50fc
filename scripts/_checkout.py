"""Makes the checkout importable as `fruitlangs`, whatever its folder is called; import this first.

It also makes every text printable (`_console`).

An installed package or a loaded Blender extension of the same name is not changed; the checkout wins in this process.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import _console  # noqa: F401

ROOT = Path(__file__).resolve().parent.parent


def _load() -> None:
    loaded = sys.modules.get("fruitlangs")
    if loaded is not None and Path(str(loaded.__file__)).resolve().parent == ROOT:
        return
    spec = importlib.util.spec_from_file_location(
        "fruitlangs", ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fruitlangs"] = module
    spec.loader.exec_module(module)


_load()

if sys.modules.get("bpy") is not None:  # Blender runs the script: let it find packages from install_dependencies.py
    from fruitlangs.operators.package_folder import use_packages

    use_packages()
