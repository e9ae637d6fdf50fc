"""The height of fruit above the ground: which have fallen, and which are only patches of ground."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit, logit

from ...scene.camera import Camera
from ...splatting.gaussians import Gaussians
from ...splatting.subject.ground import REACH, Plane, fit_ground_plane
from ...splatting.subject.viewpoints import Subject
from ..evidence.camera_parts import split_by_cameras
from ..evidence.cluster import LIKELY, Search

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FALLEN = 0.5
"""Median diameters above the ground below which a fruit on it has its lowest point. Measured on true surfaces and on
trained Gaussians of 5 scenes: fallen fruit up to 0.34, hanging ones from 2.6."""
SUNKEN, DOUBT = 0.25, 1.5
"""Diameters above the ground below which a centre lies in the ground, and what is taken from the log odds of a fruit
there. On the sample 5 of 8 false apples lay there, with log odds of .2 to 1; the fallen apple that is found lies .43
above."""
CLEAR, FEW = 0.9, 0.05
"""Probability of a clear fruit, and the largest share of the fruit that may lie in a ground."""
NEARNESS = 0.5
"""Radius of the subject relative to the distance from which it was photographed."""
AROUND = 0.15
"""Radii of the subject around the foot of a fruit within which the height of the ground is estimated."""
RELIEF = 0.12
"""Radii of the subject by which the ground may deviate from its plane."""
LEAST_OPACITY = 0.3
FEWEST = 10
"""Gaussians needed for the height of the ground under a fruit."""


@dataclass(frozen=True, eq=False)
class Site:
    """A part of the scene with a ground of its own. fruit: (K,) index of its centres; subject: what its cameras see."""

    fruit: IntArray
    subject: Subject


def find_fallen(
    gaussians: Gaussians, cameras: Sequence[Camera], centers: FloatArray, diameters: FloatArray, up: FloatArray
) -> list[bool | None]:
    """Find whether each of F fruit lies on the ground; None if no ground is visible there. Arguments as of
    `heights_above_ground`; cameras: of the scene; diameters: (F,) scene units.

    None for a whole site if centres lie below what seems to be its ground: then it is none, for example the lower side
    of a crown.
    """
    heights = np.full(len(centers), np.nan)
    for site, near in _select_grounds(gaussians, find_sites(centers, np.ones(len(centers), bool), cameras), centers):
        own = heights_above_ground(near, site.subject, centers[site.fruit], up)
        if (own < 0.0).mean() <= FEW:
            heights[site.fruit] = own
    lowest = heights - 0.5 * diameters
    lying = (lowest < FALLEN * np.median(diameters)).tolist() if len(centers) else []
    return [None if lost else low for lost, low in zip(np.isnan(lowest).tolist(), lying, strict=True)]


def doubt_sunken(found: Search, gaussians: Gaussians, cameras: Sequence[Camera], up: FloatArray) -> Search:
    """The search with less probable candidates where the centre lies in the ground, not above it: most of them are
    patches of ground that look like fruit. Arguments as of `find_fallen`.

    Unchanged in a site without clear candidates, and where clear fruit lie in what seems to be the ground: then it is
    none.
    """
    centers, probabilities = found.found.spheres.centers, found.probabilities
    clear, sunken = probabilities > CLEAR, np.zeros(len(centers), bool)
    if not clear.any():
        return found
    for site, near in _select_grounds(gaussians, find_sites(centers, probabilities > LIKELY, cameras), centers):
        heights = heights_above_ground(near, site.subject, centers[site.fruit], up)
        own = heights < SUNKEN * found.size.diameter
        surely = own[clear[site.fruit]]
        if len(surely) and surely.mean() <= FEW:
            sunken[site.fruit] = own
    return replace(found, probabilities=np.where(sunken, expit(logit(probabilities) - DOUBT), probabilities))


def find_sites(centers: FloatArray, likely: NDArray[np.bool_], cameras: Sequence[Camera]) -> list[Site]:
    """The sites of fruit (F, 3): those that are `likely` (F,) in parts that are no wider than their cameras are far
    away, the others with the nearest of these.

    A single tree is one site. A row is cut until the cameras of each part, those nearest to its fruit, are as far from
    it as they are from a tree.
    """
    if not likely.any():
        return []
    own, eyes = np.flatnonzero(likely), np.array([camera.center for camera in cameras])
    parts = split_by_cameras(centers[own], eyes)
    numbers = np.empty(len(own), np.int64)
    for number, part in enumerate(parts):
        numbers[part.fruit] = number
    sites = numbers[cKDTree(centers[own]).query(centers)[1]]
    return [
        Site(np.flatnonzero(sites == number), Subject(part.middle, NEARNESS * part.distance))
        for number, part in enumerate(parts)
    ]


def _select_grounds(
    gaussians: Gaussians, sites: Sequence[Site], centers: FloatArray
) -> Iterator[tuple[Site, Gaussians]]:
    """Yield each site with the Gaussians that its ground and the feet of its fruit may consist of."""
    if len(sites) == 1:
        yield sites[0], gaussians
        return
    tree = cKDTree(gaussians.means.detach().double().cpu().numpy())
    for site in sites:
        farthest = float(np.linalg.norm(centers[site.fruit] - site.subject.center, axis=1).max())
        near = tree.query_ball_point(site.subject.center, 2.0 * max(REACH * site.subject.radius, farthest))
        yield site, gaussians.select(torch.from_numpy(np.sort(np.array(near, np.int64))))


def heights_above_ground(gaussians: Gaussians, subject: Subject, centers: FloatArray, up: FloatArray) -> FloatArray:
    """(F,) how far centers (F, 3) lie above the ground near a subject, scene units; NaN where no ground is visible.

    The ground is a plane that may slope, corrected by the surface near the foot of each centre. Far away, where only
    the plane continues, the result is NaN.

    Args:
        gaussians: those that are not fruit.
        up: (3,) unit, away from the ground, roughly.
    """
    unknown = np.full(len(centers), np.nan)
    if len(gaussians) == 0:
        return unknown
    plane = fit_ground_plane(gaussians, subject, up=up)
    if plane is None:
        return unknown
    relief = _relief(gaussians, plane, centers, subject.radius)
    far = np.linalg.norm(centers - subject.center, axis=1) > REACH * subject.radius
    return np.where(far & np.isnan(relief), np.nan, plane.above(centers) - np.nan_to_num(relief))


def _relief(gaussians: Gaussians, plane: Plane, centers: FloatArray, radius: float) -> FloatArray:
    """(F,) height of the ground above its plane under each centre (F, 3), NaN if too little of it is visible.

    radius: of the subject, scene units.
    """
    means = gaussians.means.detach().double().cpu().numpy()
    above = plane.above(means)
    near = (np.abs(above) < RELIEF * radius) & (gaussians.opacities.detach().cpu().numpy() >= LEAST_OPACITY)
    means, above = means[near], above[near]
    feet = centers - plane.above(centers)[:, None] * plane.normal
    around = cKDTree(means - above[:, None] * plane.normal).query_ball_point(feet, AROUND * radius)
    return np.array([np.median(above[own]) if len(own) >= FEWEST else np.nan for own in around])
