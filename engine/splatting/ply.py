"""Gaussians as `.ply` in the layout of 3DGS, which every splat viewer reads."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError

from ..errors import FormatError
from ..storage.files import replace_file
from .gaussians import Gaussians

_GEOMETRY = ("x", "y", "z", "opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4)))
_BASE = tuple(f"f_dc_{k}" for k in range(3))
ANTIALIASED = "antialiased: fade Gaussians below a pixel"
"""Comment in the header of a file whose Gaussians were trained that way."""
_REST_COUNTS = {3 * ((degree + 1) ** 2 - 1) for degree in range(4)}


def _properties(rest: int) -> list[str]:
    """Names in the order of 3DGS, with `rest` harmonics beyond the constant ones."""
    head = ["x", "y", "z", "nx", "ny", "nz", *_BASE, *(f"f_rest_{k}" for k in range(rest))]
    return [*head, "opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]


def write_ply(path: Path, gaussians: Gaussians) -> None:
    """Write binary little-endian `.ply`: log scales, opacity logits, quaternions w x y z, f_rest channel by channel.

    The file is written atomically.

    Raises:
        OutputError: the folder cannot be written.
    """
    n = len(gaussians)
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    columns = [
        gaussians.means, torch.zeros(n, 3), gaussians.sh[:, 0], rest,
        gaussians.opacity_logits[:, None], gaussians.log_scales, gaussians.quats,
    ]  # fmt: skip
    table = torch.cat([column.detach().float() for column in columns], 1).numpy()
    names = _properties(rest.shape[1])
    vertices = np.ascontiguousarray(table, "<f4").view([(name, "<f4") for name in names]).reshape(n)
    comments = [ANTIALIASED] if gaussians.antialiased else []
    with replace_file(path) as temporary:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<", comments=comments).write(str(temporary))


def read_ply(path: Path) -> Gaussians:
    """Read the layout of 3DGS, ASCII or binary, whatever the order of its properties and its harmonics' degree.

    Raises:
        FormatError: the file is missing, cut short, not a `.ply`, or lacks what makes it Gaussians.
    """
    return gaussians_of(read_vertices(path), path)


@dataclass(frozen=True, eq=False)
class Vertices:
    """The vertices of a `.ply`: table is a structured array with one named column per property; comments of its
    header."""

    table: NDArray[np.void]
    comments: list[str]

    @property
    def names(self) -> set[str]:
        return set(self.table.dtype.names or ())

    def __len__(self) -> int:
        return len(self.table)


def has_gaussians(vertices: Vertices) -> bool:
    """Whether vertices have the properties of 3DGS Gaussians."""
    return vertices.names >= {*_GEOMETRY, *_BASE}


def gaussians_of(given: Vertices, path: Path) -> Gaussians:
    """The Gaussians of vertices in the layout of 3DGS; `path` is named in errors.

    Raises:
        FormatError: they lack what makes them Gaussians, or hold a value that is not finite.
    """
    vertices, comments, names = given.table, given.comments, given.names
    missing = [name for name in (*_GEOMETRY, *_BASE) if name not in names]
    if missing:
        raise FormatError(
            f"{path} is a .ply without {', '.join(missing[:4])}: not a 3DGS file. Export it in the 3DGS layout"
        )
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in _REST_COUNTS or any(f"f_rest_{k}" not in names for k in range(rest)):
        raise FormatError(f"{path} has {rest} f_rest properties; 3DGS has 0, 9, 24 or 45, numbered from 0")
    sh = np.concatenate(
        [
            _columns(vertices, _BASE)[:, None, :],
            _columns(vertices, [f"f_rest_{k}" for k in range(rest)])
            .reshape(len(vertices), 3, rest // 3)
            .transpose(0, 2, 1),
        ],
        axis=1,
    )
    return Gaussians(
        means=_tensor(path, "x, y, z", _columns(vertices, ("x", "y", "z"))),
        log_scales=_tensor(path, "scale", _columns(vertices, [f"scale_{k}" for k in range(3)])),
        quats=_tensor(path, "rot", _columns(vertices, [f"rot_{k}" for k in range(4)])),
        opacity_logits=_tensor(path, "opacity", _columns(vertices, ["opacity"])[:, 0]),
        sh=_tensor(path, "f_dc, f_rest", sh),
        antialiased=ANTIALIASED in comments,
    )


def read_vertices(path: Path) -> Vertices:
    """Read the vertices of any `.ply`, ASCII or binary.

    Raises:
        FormatError: the file is missing, cut short, not a `.ply`, or has no vertices.
    """
    try:
        data = PlyData.read(str(path))  # memory-mapped: without it plyfile reads number by number
        element = data["vertex"]
    except FileNotFoundError as error:
        raise FormatError(f"{path} is not there. Give the .ply of a trained scene") from error
    except KeyError as error:
        raise FormatError(f"{path} has no vertices. Give a .ply of Gaussians") from error
    except (PlyParseError, ValueError, OSError, UnicodeError, TypeError) as error:
        raise FormatError(f"{path} cannot be read as .ply ({error}). It is cut short or of another kind") from error
    return Vertices(np.array(element.data), list(data.comments))


def _columns(vertices: NDArray[np.void], names: tuple[str, ...] | list[str]) -> NDArray[np.float32]:
    if not names:
        return np.zeros((len(vertices), 0), np.float32)
    return np.stack([np.asarray(vertices[name], np.float32) for name in names], axis=1)


def _tensor(path: Path, what: str, values: NDArray[np.float32]) -> torch.Tensor:
    if not np.isfinite(values).all():
        raise FormatError(f"{path} holds NaN or infinity in {what}. Write it again from the trained scene")
    return torch.from_numpy(np.ascontiguousarray(values))
