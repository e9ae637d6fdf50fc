"""Coloured points as Gaussians: clouds of a scanner, of photogrammetry, or sampled from a NeRF."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...errors import FormatError
from ..gaussians import Gaussians, make_round_gaussians
from ..ply import Vertices

FloatArray = NDArray[np.float64]

OPACITY = 0.99
SIZE = 0.5
"""Standard deviation of a point's Gaussian in mean distances to its neighbours: just closes an even surface."""
NEIGHBOURS = 3
LARGEST = 2.0
"""Limit of the distance to a neighbour, in median distances, so that a stray point stays small."""
FEWEST = 500
"""A cloud of fewer different points does not show fruit; it is more likely a mesh."""
_COLORS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_FINEST = 2**20
"""Cells along each axis of the finest grid in which duplicates are searched."""


@dataclass(frozen=True, eq=False)
class ColoredPoints:
    """positions: (P, 3) in the file's frame; colors: (P, 3) sRGB in [0, 1]."""

    positions: FloatArray
    colors: FloatArray

    def __len__(self) -> int:
        return len(self.positions)


def has_colored_points(vertices: Vertices) -> bool:
    """Whether vertices carry positions and colours."""
    return _color_names(vertices) is not None and vertices.names >= {"x", "y", "z"}


def points_of(vertices: Vertices, path: Path) -> ColoredPoints:
    """The points of vertices with colours; points with a value that is not finite are left out, as scanners intend.

    Colours may be of any type; their range is 255 for bytes, else the least of 1, 255 and 65,535 that contains them
    all.

    Raises:
        FormatError: there are no positions or colours, or no value is finite.
    """
    names = _color_names(vertices)
    if names is None or not vertices.names >= {"x", "y", "z"}:
        raise FormatError(
            f"{path} has neither colours (red, green, blue) nor what makes Gaussians (opacity, scale_0, rot_0, f_dc_0)."
            " Export it as coloured points or in the 3DGS layout"
        )
    if len(vertices) == 0:
        raise FormatError(f"{path} holds no points. Export it again")
    try:
        positions = np.stack([np.asarray(vertices.table[axis], np.float64) for axis in "xyz"], axis=1)
        colors = np.stack([np.asarray(vertices.table[name], np.float64) for name in names], axis=1)
    except (TypeError, ValueError) as error:
        raise FormatError(f"{path} holds lists where numbers belong ({error}). Export it again") from error
    finite = np.isfinite(positions).all(axis=1) & np.isfinite(colors).all(axis=1)
    if not finite.any():
        raise FormatError(f"{path}: none of its {len(finite):,} points is finite (NaN or infinity). Export it again")
    positions, colors = positions[finite], colors[finite]
    whole = np.issubdtype(vertices.table.dtype[names[0]], np.integer)
    ranges = (255.0, 65535.0) if whole else (1.0, 255.0, 65535.0)
    most = next((most for most in ranges if colors.max() <= most), float(colors.max()))
    return ColoredPoints(positions, np.clip(colors / most, 0.0, 1.0))


def _color_names(vertices: Vertices) -> tuple[str, ...] | None:
    return next((names for names in _COLORS if vertices.names >= set(names)), None)


def thin_points(points: ColoredPoints, most: int) -> ColoredPoints:
    """Return about `most` evenly spread points: the means of those that share a cell of the finest grid that allows it.

    Points that (nearly) coincide are always merged.
    """
    middle = np.median(points.positions, axis=0)
    reach = np.quantile(np.abs(points.positions - middle).max(axis=1), 0.99)
    places = (points.positions - middle) / max(float(reach), 1e-300)  # nearly all within ±1
    finest, coarsest = math.log2(_FINEST / 2), 0.0
    cells = _cells(places, finest)
    if len(np.unique(cells)) > most:
        for _ in range(10):
            level = (finest + coarsest) / 2
            finest, coarsest = (level, coarsest) if len(np.unique(_cells(places, level))) > most else (finest, level)
        cells = _cells(places, coarsest)
    _, owner, counts = np.unique(cells, return_inverse=True, return_counts=True)

    def means(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(owner, column) / counts for column in values.T], axis=1)

    return ColoredPoints(middle + means(points.positions - middle), means(points.colors))


def _cells(places: FloatArray, level: float) -> NDArray[np.int64]:
    """(P,) number of the cell of each point on a grid of 2**level cells per unit; the outermost cells are unbounded."""
    index = np.floor(places * 2.0**level).clip(-_FINEST, _FINEST - 1).astype(np.int64) + _FINEST
    return (index[:, 0] << 42) | (index[:, 1] << 21) | index[:, 2]


def gaussians_from(points: ColoredPoints, path: Path) -> Gaussians:
    """Nearly opaque spherical Gaussians whose size follows the mean distance to the three nearest points; `path` is
    used in errors.

    Raises:
        FormatError: there are too few points, or they lie too far from the origin to be distinguished in float32.
    """
    if len(points) < FEWEST:
        raise FormatError(
            f"{path} has only {len(points)} different points. Give a cloud of at least {FEWEST:,} (of a mesh,"
            " sample its surface first)"
        )
    distances = cKDTree(points.positions).query(points.positions, k=NEIGHBOURS + 1)[0][:, 1:].mean(axis=1)
    typical = float(np.median(distances))
    if typical < 8.0 * float(np.spacing(np.float32(np.median(np.abs(points.positions).max(axis=1))))):
        raise FormatError(
            f"{path}: its points lie so far from the origin that 32-bit numbers cannot tell them apart. Subtract an"
            " offset from the coordinates first"
        )
    sizes = SIZE * np.minimum(distances, LARGEST * typical)
    return make_round_gaussians(points.positions, sizes, points.colors, opacity=OPACITY)
