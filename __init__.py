# SPDX-License-Identifier: GPL-3.0-or-later
"""FruitLangs counts fruit from photos of trees: a Python package and a Blender extension.

The Python interface is the names of `__all__`. Each is imported when it is first used: `import fruitlangs` takes no
time, and Blender can enable the extension while packages are missing.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .engine.config import Config
    from .engine.counting.fruit import Fruit
    from .engine.errors import FruitLangsError
    from .engine.open_result import open_result
    from .engine.pipeline import count_scene, reconstruct_scene
    from .engine.publishing import Result

__version__: str

__all__ = ["Config", "Fruit", "FruitLangsError", "Result", "count_scene", "open_result", "reconstruct_scene"]

_MODULES = {
    "Config": ".engine.config",
    "Fruit": ".engine.counting.fruit",
    "FruitLangsError": ".engine.errors",
    "Result": ".engine.publishing",
    "count_scene": ".engine.pipeline",
    "open_result": ".engine.open_result",
    "reconstruct_scene": ".engine.pipeline",
}
"""{exported name: the module that defines it}."""


def __getattr__(name: str) -> Any:
    """Import an exported name, or read the version, when it is first used."""
    if name == "__version__":
        value = _read_version()
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name], __name__), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def _read_version() -> str:
    """The version in the manifest, its only place."""
    import tomllib

    manifest = Path(__file__).with_name("blender_manifest.toml").read_text(encoding="utf-8")
    return str(tomllib.loads(manifest)["version"])


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from .fruitlangs_addon import registration

    registration.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from .fruitlangs_addon import registration

    registration.unregister()
