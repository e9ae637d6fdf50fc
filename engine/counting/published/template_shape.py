"""The shape that clusters are compared with: the surface of one fruit as points, from a file, from the scene, or a
sphere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...errors import ConfigError, FormatError
from ..geometry.alpha_shape import alpha_shape_volume
from ..geometry.sphere import unit_directions

FloatArray = NDArray[np.float64]

ALPHA = 0.65
"""Radius, in fruit diameters, of the ball that defines an alpha shape. Points of a surface are hollow: a ball smaller
than the fruit gets in between them, and a much larger one fills the gaps between touching fruit."""
POINTS = 250
"""Points of a template."""
FEWEST = 30
"""Least points of a cloud that defines a shape."""
LEAST_FULL = 1e-3
"""Least share of its bounding box that a template fills."""


@dataclass(frozen=True, eq=False)
class Template:
    """points: (T, 3) of a fruit's surface about its centre of mass, in mean fruit diameters; volume: their alpha
    shape's, in cubed diameters.
    """

    points: FloatArray
    volume: float

    @classmethod
    def of(cls, points: FloatArray) -> Template:
        """The template of points (T, 3) about the origin, in fruit diameters."""
        return cls(points, alpha_shape_volume(points, ALPHA))


def ball() -> Template:
    """A sphere of one diameter."""
    return Template.of(0.5 * unit_directions(POINTS))


def cut_template(points: FloatArray) -> Template:
    """Make a template of the points (M, 3) of a fruit in a scene, in fruit diameters; of many points, an even
    sample."""
    thinned = points[np.linspace(0, len(points) - 1, min(len(points), POINTS)).astype(np.int64)]
    return Template.of(thinned - _middle(points))


def read_template(path: Path, *, seed: int = 0) -> Template:
    """A fruit's shape from a mesh (.obj, .ply, .glb, .stl, …) or a point cloud (.ply, .xyz, …), of any size.

    It is scaled to the volume of a sphere of one diameter; points are spread evenly over a mesh, by `seed`.

    Raises:
        ConfigError: there is no such file.
        FormatError: it cannot be read, a number in it is not finite, the mesh has a hole, or it holds no volume.
    """
    if not path.is_file():
        raise ConfigError(f"--count.template {path} does not exist. Give a mesh or a point cloud of one fruit")
    try:
        shape = trimesh.load(path)
        if isinstance(shape, trimesh.Scene):
            shape = shape.to_mesh() if len(shape.geometry) > 1 else shape.to_geometry()
    except Exception as error:  # the errors of trimesh's readers have no common class
        raise FormatError(f"{path} cannot be read as a mesh or a point cloud: {_line(error)}") from error
    vertices = np.asarray(getattr(shape, "vertices", ()), np.float64).reshape(-1, 3)
    if len(vertices) == 0:
        raise FormatError(f"{path} holds neither a mesh nor points. Export one fruit's surface into it")
    if not np.isfinite(vertices).all():
        raise FormatError(f"{path} holds coordinates that are not finite. Export the template again")
    if isinstance(shape, trimesh.Trimesh) and len(shape.faces):
        return _template_of_mesh(shape, path, seed)
    return _template_of_cloud(vertices, path, seed)


def _template_of_mesh(mesh: trimesh.Trimesh, path: Path, seed: int) -> Template:
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if not mesh.is_watertight:
        raise FormatError(f"{path} is a mesh with a hole. Close it (Blender: Mesh, Clean Up, Fill Holes)")
    if not mesh.is_winding_consistent:
        mesh.fix_normals()
    volume = _check_volume(abs(float(mesh.volume)), mesh.extents, path)
    size = np.cbrt(6.0 * volume / np.pi)
    spread = trimesh.sample.sample_surface(mesh, 8 * POINTS, seed=seed)[0]
    points = _sample_farthest(np.asarray(spread, np.float64), POINTS)
    return Template.of((points - mesh.center_mass) / size)


def _template_of_cloud(points: FloatArray, path: Path, seed: int) -> Template:
    points = np.unique(points, axis=0)
    if len(points) < FEWEST:
        raise FormatError(f"{path} has {len(points)} points. A template needs at least {FEWEST}, all over one fruit")
    volume = _check_volume(alpha_shape_volume(points, np.inf), np.ptp(points, axis=0), path)
    order = np.random.default_rng(seed).permutation(len(points))[: 8 * POINTS]
    points = (_sample_farthest(points[order], POINTS) - _middle(points)) / np.cbrt(6.0 * volume / np.pi)
    return Template.of(points)


def _middle(points: FloatArray) -> FloatArray:
    """(3,) centre of mass of the convex hull of points (M, 3)."""
    return np.asarray(trimesh.convex.convex_hull(points).center_mass, np.float64)


def _check_volume(volume: float, extents: Sequence[float] | FloatArray, path: Path) -> float:
    if not volume > LEAST_FULL * float(np.max(extents)) ** 3:
        raise FormatError(f"{path} holds no volume: it is flat or a line. A template shows a fruit from all sides")
    return volume


def _sample_farthest(points: FloatArray, count: int) -> FloatArray:
    """Sample at most `count` of the points (M, 3), each the one farthest from those before."""
    chosen, gap = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _line(error: Exception) -> str:
    """The text of an error in one line, or its class if it has none."""
    return " ".join(str(error).split()) or type(error).__name__
