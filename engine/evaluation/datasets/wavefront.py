"""The objects of a Wavefront .obj mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError


@dataclass(frozen=True, eq=False)
class MeshObject:
    """One object of a mesh. name: after its `o`; vertices: (V, 3) in the file's frame."""

    name: str
    vertices: NDArray[np.float64]


def read_objects(path: Path) -> list[MeshObject]:
    """The objects in the order of the file, each with the vertices that follow its `o` line; faces are ignored.

    Raises:
        FormatError: the file is missing, or a vertex is not three finite numbers.
    """
    objects: list[tuple[str, list[list[float]]]] = [("", [])]
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            for number, line in enumerate(file, 1):
                kind, _, rest = line.strip().partition(" ")
                if kind == "o":
                    objects.append((rest.strip(), []))
                elif kind == "v":
                    objects[-1][1].append(_vertex(rest, f"{path}: line {number}"))
    except OSError as error:
        raise FormatError(
            f"{path}: cannot be read ({error.strerror}). Expected an .obj with one object per fruit"
        ) from error
    return [MeshObject(name, np.array(points, dtype=np.float64).reshape(-1, 3)) for name, points in objects if points]


def _vertex(text: str, where: str) -> list[float]:
    try:
        place = [float(word) for word in text.split()[:3]]  # some writers append a colour
    except ValueError:
        place = []
    if len(place) != 3 or not np.isfinite(place).all():
        raise FormatError(
            f"{where} is not a vertex of three finite numbers. Expected an .obj with one object per fruit"
        )
    return place
