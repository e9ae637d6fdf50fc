"""Lets every text be printed on consoles and into files of any encoding, such as Windows' cp1252 or the C locale."""

from __future__ import annotations

import codecs
import sys
import unicodedata

PLAIN = {
    **{"–": "-", "—": "-", "−": "-", "×": "x", "→": "->", "…": "...", "≥": ">=", "≤": "<=", "≈": "about", "·": "*"},
    **{"τ": "tau", "σ": "sigma", "Σ": "sum", "Π": "product", "√": "sqrt", "°": " deg", "±": "+-", "’": "'"},
    **{"“": '"', "”": '"', "‘": "'", "\N{NARROW NO-BREAK SPACE}": " "},
}
"""{character: what stands for it where it cannot be printed}; letters lose their accents, all else becomes "?"."""


def _plain(error: UnicodeError) -> tuple[str, int]:
    """What replaces the characters that an encoding lacks."""
    assert isinstance(error, UnicodeEncodeError)
    text = ""
    for character in error.object[error.start : error.end]:
        bare = unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode("ascii")
        text += PLAIN.get(character) or bare or "?"
    return text, error.end


codecs.register_error("plain", _plain)
for stream in (sys.stdout, sys.stderr):
    if hasattr(stream, "reconfigure"):  # a test's or Blender's may be another object
        stream.reconfigure(errors="plain")
