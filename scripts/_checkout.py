"""Makes the checkout importable as `fruitlangs`, whatever its folder is called; import this first.

It also lets every text be printed on consoles and into files of any encoding, such as Windows' cp1252 or the C locale.

An installed package or a loaded Blender extension of the same name is not changed; the checkout wins in this process.
"""

from __future__ import annotations

import codecs
import importlib.util
import sys
import unicodedata
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

PLAIN = {
    **{"–": "-", "—": "-", "−": "-", "×": "x", "→": "->", "…": "...", "≥": ">=", "≤": "<=", "≈": "about", "·": "*"},
    **{"τ": "tau", "σ": "sigma", "Σ": "sum", "Π": "product", "√": "sqrt", "°": " deg", "±": "+-", "’": "'"},
    **{"“": '"', "”": '"', "‘": "'", "\N{NARROW NO-BREAK SPACE}": " "},
}
"""{character: what stands for it where it cannot be printed}; letters lose their accents, all else becomes "?"."""


def _replace_characters(error: UnicodeError) -> tuple[str, int]:
    """Return what replaces the characters that an encoding lacks."""
    assert isinstance(error, UnicodeEncodeError)
    text = ""
    for character in error.object[error.start : error.end]:
        bare = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode("ascii")
        text += PLAIN.get(character) or bare or "?"
    return text, error.end


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


codecs.register_error("plain", _replace_characters)
for stream in (sys.stdout, sys.stderr):
    if hasattr(stream, "reconfigure"):  # a test's or Blender's may be another object
        stream.reconfigure(errors="plain")
_load()

if sys.modules.get("bpy") is not None:  # Blender runs the script: let it find packages from install_dependencies.py
    from fruitlangs.operators.package_folder import use_packages

    use_packages()
