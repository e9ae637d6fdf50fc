"""Small made-up point clouds as .ply for the tests of imported reconstructions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from plyfile import PlyData, PlyElement

RGB = ("red", "green", "blue")


def grid(side: int = 10, spacing: float = 0.1) -> np.ndarray:
    """(side³, 3) points of a cubic grid."""
    axis = np.arange(side) * spacing
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def write_cloud(
    path: Path,
    points: np.ndarray,
    colors: np.ndarray | None,
    *,
    kind: str = "u1",
    place: str = "f4",
    text: bool = False,
) -> Path:
    """Write points (P, 3) and, unless None, their colours (P, 3) as properties of the given types."""
    fields: list[tuple[str, Any]] = [(axis, place) for axis in "xyz"]
    fields += [] if colors is None else [(name, kind) for name in RGB]
    table = np.zeros(len(points), dtype=fields)
    for axis, column in zip("xyz", np.reshape(points, (-1, 3)).T, strict=True):
        table[axis] = column
    if colors is not None:
        for name, column in zip(RGB, np.reshape(colors, (-1, 3)).T, strict=True):
            table[name] = column
    PlyData([PlyElement.describe(table, "vertex")], text=text).write(str(path))
    return path
