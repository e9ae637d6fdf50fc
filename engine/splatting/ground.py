"""Which way is up in a reconstruction without cameras: away from the ground that its subject stands on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .gaussians import Gaussians
from .viewpoints import Subject

FloatArray = NDArray[np.float64]

REACH = 3.0
"""Radii of the subject around its middle within which its ground is sought."""
THICKNESS = 0.06
"""Radii of the subject by which the ground may lie off a plane."""
LEAST_SHARE = 0.15
"""Share of all surface that the ground has to make up."""
COST_OF_BELOW = 2.0
"""How much surface in a plane outweighs surface below it: there is next to nothing below the ground."""
TRIALS = 1000
MOST_LOOKED_AT = 8000


def up_from_ground(gaussians: Gaussians, subject: Subject, *, seed: int = 0) -> FloatArray | None:
    """(3,) unit vector up from the plane that most surface near the subject lies in and next to none below.

    A Gaussian's surface is its opacity times its size squared, since a lawn is drawn by few large ones. Planes through
    three random Gaussians each are tried, and the best is fitted to what lies in it. None where no plane is a ground,
    as in a cloud of nothing but a tree.
    """
    random = np.random.default_rng(seed)
    places = (gaussians.means.detach().double().numpy() - subject.center) / subject.radius
    near = np.flatnonzero(np.linalg.norm(places, axis=1) <= REACH)
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
    if len(ups) == 0:
        return None
    scores = [_share(up, height, places, surface, cost=COST_OF_BELOW) for up, height in zip(ups, heights, strict=True)]
    best = int(np.argmax(scores))
    if _share(ups[best], heights[best], places, surface, cost=0.0) < LEAST_SHARE or scores[best] <= 0.0:
        return None
    ground = np.abs(places @ ups[best] - heights[best]) < THICKNESS
    return _normal(places[ground], surface[ground], towards=ups[best])


def _share(up: FloatArray, height: float, places: FloatArray, surface: FloatArray, *, cost: float) -> float:
    """Share of the surface (N,) at `places` (N, 3) that lies in a plane, less `cost` times what lies below it."""
    above = places @ up - height
    return float(surface[np.abs(above) < THICKNESS].sum() - cost * surface[above <= -THICKNESS].sum())


def _normal(places: FloatArray, weights: FloatArray, *, towards: FloatArray) -> FloatArray:
    """(3,) unit normal of the plane fitted to weighted `places` (N, 3), on the side of `towards`."""
    centered = places - np.average(places, axis=0, weights=weights)
    normal = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, centered, centered))[1][:, 0]
    return normal if normal @ towards >= 0.0 else -normal
