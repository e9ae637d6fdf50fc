"""Fruit bodies: solids of revolution with a signed distance, so that fruit can touch without overlapping."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Body:
    """One fruit's solid in the world frame (metres); its axis runs from the far end to the stalk.

    `profile` is (K, 2): (height along the axis from the centroid, radius), the stalk's end first, at world scale.
    """

    center: FloatArray
    axis: FloatArray
    profile: FloatArray

    @property
    def reach(self) -> float:
        """Radius of the sphere around the centre that contains the body."""
        return float(np.hypot(self.profile[:, 0], self.profile[:, 1]).max())

    @property
    def top(self) -> FloatArray:
        """(3,) where the stalk leaves the body."""
        return self.center + self.axis * self.profile[0, 0]


def smooth_profile(points: tuple[tuple[float, float], ...], count: int) -> FloatArray:
    """Return the points (count, 2) at even arc length on the Catmull–Rom curve, of unit volume diameter, centroid at
    height 0."""
    p = np.asarray(points, dtype=np.float64)
    ends = [2 * p[0] - p[1], *p, 2 * p[-1] - p[-2]]
    ends[0][1], ends[-1][1] = -p[1, 1], -p[-2, 1]
    ends[0][0], ends[-1][0] = p[1, 0], p[-2, 0]
    t = np.linspace(0, 1, 16, endpoint=False)[:, None]
    pieces = []
    for a, b, c, d in zip(ends, ends[1:], ends[2:], ends[3:], strict=False):
        pieces.append(0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3))
    dense = np.vstack([*pieces, p[-1:]])
    dense[:, 1] = np.maximum(dense[:, 1], 0.0)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(dense, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], count)
    curve = np.stack([np.interp(even, length, dense[:, 0]), np.interp(even, length, dense[:, 1])], axis=1)
    curve[0, 1] = curve[-1, 1] = 0.0
    return normalise_profile(curve)


def normalise_profile(profile: FloatArray) -> FloatArray:
    """Scale the profile so that the sphere of equal volume has diameter 1, and move it to its volume centroid."""
    z, r = profile[:, 0], profile[:, 1]
    dz = -np.diff(z)
    # Frusta between the rings; heights descend from the stalk's end, and a dip counts negatively.
    volumes = np.pi / 3 * dz * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2)
    centroid = float((volumes * (z[1:] + z[:-1]) / 2).sum() / volumes.sum())
    scale = 1.0 / (6.0 * volumes.sum() / np.pi) ** (1 / 3)
    return np.stack([(z - centroid) * scale, r * scale], axis=1)


def measure_signed_distance(body: Body, points: FloatArray) -> FloatArray:
    """Measure the distance (M,) of (M, 3) points to the body's surface, negative inside."""
    offset = points - body.center
    height = offset @ body.axis
    radius = np.sqrt(np.maximum((offset**2).sum(axis=1) - height**2, 0.0))
    a, b = body.profile[:-1], body.profile[1:]
    edge = b - a
    q = np.stack([height, radius], axis=1)[:, None, :]
    along = ((q - a) * edge).sum(axis=2) / np.maximum((edge**2).sum(axis=1), 1e-18)
    nearest = a + np.clip(along, 0.0, 1.0)[:, :, None] * edge
    distance = np.linalg.norm(q - nearest, axis=2).min(axis=1)
    # Even-odd rule along the ray of growing radius; the axis closes the outline.
    z = height[:, None]
    spans = (a[:, 0] > z) != (b[:, 0] > z)
    slope = np.where(np.abs(edge[:, 0]) > 1e-12, edge[:, 0], 1e-12)
    crossing = a[:, 1] + (z - a[:, 0]) / slope * edge[:, 1]
    inside = (spans & (crossing > radius[:, None])).sum(axis=1) % 2 == 1
    return np.where(inside, -distance, distance)


def frame_of(axis: FloatArray) -> FloatArray:
    """(3, 3) rotation whose third column is the unit axis."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(axis[0]) < 0.8 else np.array([0.0, 1.0, 0.0])
    x = np.cross(helper, axis)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(axis, x), axis], axis=1)


def surface_points(body: Body, segments: int = 16) -> FloatArray:
    """(M, 3) points on the body, ring by ring."""
    angles = np.linspace(0.0, 2 * np.pi, segments, endpoint=False)
    z = np.repeat(body.profile[:, 0], segments)
    r = np.repeat(body.profile[:, 1], segments)
    turn = np.tile(angles, len(body.profile))
    local = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    return body.center + local @ frame_of(body.axis).T


def measure_gap(a: Body, b: Body) -> float:
    """Measure the least distance between two bodies; negative: depth of the overlap."""
    if np.linalg.norm(a.center - b.center) > a.reach + b.reach:
        return float(np.linalg.norm(a.center - b.center) - a.reach - b.reach)
    return float(
        min(measure_signed_distance(a, surface_points(b)).min(), measure_signed_distance(b, surface_points(a)).min())
    )
