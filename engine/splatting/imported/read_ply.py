"""Reads the reconstruction of another program: 3DGS Gaussians or coloured points in a `.ply`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from ...errors import FormatError
from ..gaussians import Gaussians
from ..ply import gaussians_of, has_gaussians, read_vertices
from .points import gaussians_from, has_colored_points, points_of, thin_points

MOST_POINTS = 300_000
"""Larger clouds are thinned to about this many points."""


@dataclass(frozen=True, eq=False)
class ImportedPly:
    """The content of a file. kind: of its vertices; notices: messages for the user about how they were read."""

    gaussians: Gaussians
    kind: Literal["gaussians", "points"]
    notices: Sequence[str] = ()


def read_imported_ply(path: Path, *, most_points: int = MOST_POINTS) -> ImportedPly:
    """Read 3DGS Gaussians unchanged, or coloured points as Gaussians (see `gaussians_from`).

    most_points: larger clouds are thinned evenly to about this many.

    Raises:
        FormatError: the file is missing, cut short, holds neither, or holds too little or what is not finite.
    """
    vertices = read_vertices(path)
    looks_like_gaussians = bool(vertices.names & {"opacity", "f_dc_0", "scale_0"})
    if has_gaussians(vertices) or (looks_like_gaussians and not has_colored_points(vertices)):
        if len(vertices) == 0:
            raise FormatError(f"{path} holds no Gaussians. Export it again")
        return ImportedPly(gaussians_of(vertices, path), "gaussians")
    finite = points_of(vertices, path)
    points = thin_points(finite, most_points)
    notices = []
    if len(finite) < len(vertices):
        notices.append(f"{len(vertices) - len(finite):,} points of {path.name} are not finite and were left out")
    if len(finite) > most_points:
        notices.append(f"the {len(finite):,} points of {path.name} were thinned to {len(points):,}")
    return ImportedPly(gaussians_from(points, path), "points", notices)
