"""Coloured points of a published data set, written as a .ply."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...storage.files import replace_file


@dataclass(frozen=True, eq=False)
class ColoredCloud:
    """P points. points: (P, 3) in the frame of the truth; colors: (P, 3) uint8 sRGB."""

    points: NDArray[np.float64]
    colors: NDArray[np.uint8]


def cloud_of(rows: NDArray[np.float64]) -> ColoredCloud:
    """The cloud of rows (P, ≥ 6) of x, y, z, red, green, blue; colours 0–255."""
    return ColoredCloud(rows[:, :3], np.clip(np.rint(rows[:, 3:6]), 0, 255).astype(np.uint8))


def write_cloud(path: Path, cloud: ColoredCloud) -> None:
    """Write a binary .ply with x, y, z, red, green, blue per vertex.

    Raises:
        OutputError: the file cannot be written.
    """
    from plyfile import PlyData, PlyElement

    fields = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    vertices = np.zeros(len(cloud.points), dtype=fields)
    for column, axis in enumerate("xyz"):
        vertices[axis] = cloud.points[:, column]
    for column, channel in enumerate(("red", "green", "blue")):
        vertices[channel] = cloud.colors[:, column]
    with replace_file(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(str(temporary))
