"""The ground under a subject, which defines up in a reconstruction without cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..gaussians import Gaussians
from .viewpoints import Subject

FloatArray = NDArray[np.float64]

REACH = 3.0
"""Radii of the subject around its middle within which its ground is searched."""
THICKNESS = 0.06
"""Distance of the ground from a plane, in radii of the subject."""
LEAST_SHARE = 0.15
"""Least share of all surface that is ground."""
COST_OF_BELOW = 2.0
"""Weight of surface below a plane relative to surface in it: almost nothing lies below the ground."""
STEEPEST = 0.8
"""Least cosine between the normal of a ground and a known up: orchards have no slopes above 37 degrees."""
TRIALS = 1000
MOST_LOOKED_AT = 8000


@dataclass(frozen=True, eq=False)
class Plane:
    """The points p with p · normal = height. normal: (3,) unit, away from the ground; height in scene units."""

    normal: FloatArray
    height: float

    def above(self, points: FloatArray) -> FloatArray:
        """(N,) how far above the plane the points (N, 3) lie, scene units; negative below it."""
        return points @ self.normal - self.height


def up_from_ground(gaussians: Gaussians, subject: Subject, *, seed: int = 0) -> FloatArray | None:
    """(3,) unit vector up from the ground near the subject (see `fit_ground_plane`); None if there is none."""
    plane = fit_ground_plane(gaussians, subject, seed=seed)
    return None if plane is None else plane.normal


def fit_ground_plane(
    gaussians: Gaussians, subject: Subject, *, up: FloatArray | None = None, seed: int = 0
) -> Plane | None:
    """Find the plane that contains most surface near the subject and has almost none below it; it need not be level.

    The surface of a Gaussian is its opacity times its size squared, because few large ones represent a lawn. Planes
    through three random Gaussians each are tried, only those that face a known `up` (3,), and the best is refined. None
    if no plane is a ground, as in a cloud of a tree alone.
    """
    random = np.random.default_rng(seed)
    places = (gaussians.means.detach().double().numpy() - subject.center) / subject.radius
    near = np.flatnonzero(np.linalg.norm(places, axis=1) <= REACH)
    near = near[np.lexsort(places[near].T)]  # the same draws in any order of the Gaussians
    if len(near) > MOST_LOOKED_AT:
        near = np.sort(random.choice(near, MOST_LOOKED_AT, replace=False))
    widths = gaussians.scales.detach().double().numpy()[near].max(axis=1) / subject.radius
    surface = gaussians.opacities.detach().double().numpy()[near] * np.minimum(widths, THICKNESS) ** 2
    if len(near) < 3 or not surface.any():
        return None
    places, surface = places[near], surface / surface.sum()
    corners = places[random.choice(len(places), (TRIALS, 3), p=surface)]
    ups = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(ups, axis=1)
    ups, corners = ups[lengths > 1e-3] / lengths[lengths > 1e-3, None], corners[lengths > 1e-3]
    heights = np.einsum("ti,ti->t", ups, corners[:, 0])
    ups, heights = np.where(heights > 0, -1, 1)[:, None] * ups, -np.abs(heights)  # the subject's middle is above
    if up is not None:
        facing = ups @ up > STEEPEST
        ups, heights = ups[facing], heights[facing]
    if len(ups) == 0:
        return None
    scores = [_share(up, height, places, surface, cost=COST_OF_BELOW) for up, height in zip(ups, heights, strict=True)]
    best = int(np.argmax(scores))
    if _share(ups[best], heights[best], places, surface, cost=0.0) < LEAST_SHARE or scores[best] <= 0.0:
        return None
    ground = np.abs(places @ ups[best] - heights[best]) < THICKNESS
    normal = _normal(places[ground], surface[ground], towards=ups[best])
    height = float(np.average(places[ground] @ normal, weights=surface[ground]))
    return Plane(normal, float(subject.center @ normal) + subject.radius * height)


def _share(up: FloatArray, height: float, places: FloatArray, surface: FloatArray, *, cost: float) -> float:
    """Share of the surface (N,) at `places` (N, 3) that lies in a plane, minus `cost` times the share below it."""
    above = places @ up - height
    return float(surface[np.abs(above) < THICKNESS].sum() - cost * surface[above <= -THICKNESS].sum())


def _normal(places: FloatArray, weights: FloatArray, *, towards: FloatArray) -> FloatArray:
    """(3,) unit normal of the plane fitted to weighted `places` (N, 3), on the side of `towards`."""
    centered = places - np.average(places, axis=0, weights=weights)
    normal = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, centered, centered))[1][:, 0]
    return normal if normal @ towards >= 0.0 else -normal
