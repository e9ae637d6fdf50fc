"""Splats: what the viewport draws for Gaussians and sparse points, as plain arrays, from a mesh or from training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ...engine.language.teaching.ray_hits import rotation_rows
from ..blender_data import get_attribute, linear_from_srgb

FloatArray = NDArray[np.float32]

ANTIALIASED = "fruitlangs_antialiased"
"""Custom property of the Gaussians' mesh: they were trained to fade below a pixel's size (`Gaussians.antialiased`)."""
ATTRIBUTES = ("position", "scale", "quaternion", "radiance:base", "opacity", "probability")
"""Attributes that a mesh needs to be drawn as splats."""
POINT_ATTRIBUTES = ("position", "radiance:base")
"""… and those of sparse points."""
POINT_SIGMA, POINT_OPACITY = 0.5, 0.95
"""The splat of a sparse point: standard deviation in radii of the point, so that it looks as wide; opacity."""


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians in an object's frame, float32.

    means: (N, 3); covariances: (N, 6) xx, xy, xz, yy, yz, zz; colors: (N, 3) linear, without view dependence;
    opacities: (N,); probability: (N,) of the prompt, None before one was answered; antialiased: they fade below a
    pixel's size.
    """

    means: FloatArray
    covariances: FloatArray
    colors: FloatArray
    opacities: FloatArray
    probability: FloatArray | None
    antialiased: bool = False

    def __len__(self) -> int:
        return len(self.means)


def splats_of_mesh(mesh: bpy.types.Mesh) -> Splats | None:
    """The splats of a Gaussian object's mesh; None while it is edited, or if an attribute is missing."""
    if mesh.is_editmode or any(name not in mesh.attributes for name in ATTRIBUTES):
        return None
    probability = get_attribute(mesh, "probability")
    return Splats(
        means=get_attribute(mesh, "position"),
        covariances=pack_covariances(get_attribute(mesh, "scale"), get_attribute(mesh, "quaternion")),
        colors=get_attribute(mesh, "radiance:base")[:, :3],
        opacities=get_attribute(mesh, "opacity"),
        probability=probability if probability.any() else None,
        antialiased=bool(mesh.get(ANTIALIASED, False)),
    )


def splats_of_points(mesh: bpy.types.Mesh, radius: float) -> Splats | None:
    """Round splats of the sparse points of a mesh, with a radius in its frame; None as in `splats_of_mesh`."""
    if mesh.is_editmode or any(name not in mesh.attributes for name in POINT_ATTRIBUTES):
        return None
    means = get_attribute(mesh, "position")
    variance = np.float32((POINT_SIGMA * radius) ** 2)
    return Splats(
        means=means,
        covariances=np.tile(variance * np.array([1, 0, 0, 1, 0, 1], np.float32), (len(means), 1)),
        colors=get_attribute(mesh, "radiance:base")[:, :3],
        opacities=np.full(len(means), POINT_OPACITY, np.float32),
        probability=None,
    )


def splats_in_training(means: Any, scales: Any, quats: Any, srgb: Any, opacities: Any, antialiased: bool) -> Splats:
    """The splats of the current state of training; copies, because training continues to change its own."""
    return Splats(
        means=np.array(means, np.float32),
        covariances=pack_covariances(np.asarray(scales, np.float32), np.asarray(quats, np.float32)),
        colors=linear_from_srgb(srgb).astype(np.float32),
        opacities=np.array(opacities, np.float32),
        probability=None,
        antialiased=antialiased,
    )


def pack_covariances(scales: FloatArray, quats: FloatArray) -> FloatArray:
    """Pack the upper triangles (N, 6) xx, xy, xz, yy, yz, zz of R diag(σ²) Rᵀ.

    scales: (N, 3) standard deviations σ; quats: (N, 4) rotations w, x, y, z, not necessarily unit.
    """
    # Rows of R diag(σ).
    a, b, c = ([entry * size for entry, size in zip(row, scales.T, strict=True)] for row in rotation_rows(quats))
    pairs = ((a, a), (a, b), (a, c), (b, b), (b, c), (c, c))
    packed = [p[0] * q[0] + p[1] * q[1] + p[2] * q[2] for p, q in pairs]
    return np.ascontiguousarray(np.stack(packed, axis=1), np.float32)
