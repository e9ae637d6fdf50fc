"""Import this first: it makes the checkout importable as `fruitlangs`, whatever its folder is called.

An installed package or a loaded Blender extension of the same name is not touched; the checkout wins for this process.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

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

if sys.modules.get("bpy") is not None:  # Blender runs the script: let it find what install_dependencies.py installed
    from fruitlangs.operators.package_folder import use_packages

    use_packages()
