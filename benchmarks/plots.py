"""Plots as files: whole or not at all, and the same bytes for the same numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..engine.storage.files import replace_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save_plot(figure: Figure, path: Path, *, dpi: int = 110) -> None:
    """Write a figure as PNG.

    Raises:
        OutputError: the file cannot be written.
    """
    with replace_file(path) as temporary:
        figure.savefig(temporary, dpi=dpi, format="png", metadata={"Software": None})
