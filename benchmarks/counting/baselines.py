"""Baselines of counting, on the same points and the same estimated size as our method."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.cluster import DBSCAN, KMeans

from ...engine.config import CountConfig
from ...engine.counting.count import count_fruit
from ...engine.counting.evidence.candidates import OVERLAP, SurfaceIndex, vote
from ...engine.counting.evidence.size import FruitSize
from ...engine.counting.evidence.surface_points import SurfacePoints, sample_enough
from ...engine.counting.evidence.visibility import Visibility, find_visibility
from ...engine.counting.geometry.sphere import REACH, fit_spheres
from ...engine.counting.sizing import fruit_size, select_gaussians
from ...engine.errors import CountingError
from ...engine.scene.camera import Camera
from ...engine.splatting.gaussians import Gaussians

FloatArray = NDArray[np.float64]
Found = tuple[FloatArray, FloatArray]
"""Centres (F, 3) and diameters (F,)."""
NONE: Found = (np.zeros((0, 3)), np.zeros(0))

LINK, LEAST = 0.15, 8
"""DBSCAN's ε, in diameters, and min_samples."""
LEAST_MASS = 0.15
"""A cluster with less than this share of the points of a fruit is dropped."""
VOTE_SHARE = 0.02
"""Least votes of a centre in plain voting, relative to the densest tenth: with the product's value it is worse."""
PRIOR_SD = 0.2
"""Deviation of log diameter between fruit in plain voting."""
WEAKEST = 0.15
"""A sphere with less than this share of the best sphere's points is dropped."""


@dataclass(frozen=True, eq=False)
class Surface:
    """The input of every method: N Gaussians with probability (N,) of being fruit, cameras and visibility, and surface
    points with the size; None if no part of the scene is round.
    """

    gaussians: Gaussians
    probability: torch.Tensor
    cameras: Sequence[Camera]
    visibility: Visibility
    sample: tuple[SurfacePoints, FruitSize] | None


def surface_of(gaussians: Gaussians, probability: torch.Tensor, cameras: Sequence[Camera]) -> Surface:
    """The points and the size that the product's default starts from, by its own functions; probability: (N,)."""
    probabilities, config = probability.double().numpy(), CountConfig()
    visibility = find_visibility(gaussians, cameras)
    selected = select_gaussians(gaussians, probabilities, config)
    seen = selected[visibility.weights[selected] > 0]
    size = fruit_size(gaussians, probabilities, visibility, seen, config) if len(seen) else None
    if size is None:
        return Surface(gaussians, probability, cameras, visibility, None)
    points = sample_enough(
        gaussians, probabilities, visibility, seen, diameter=size.diameter, most=config.sample_budget, seed=config.seed
    )
    return Surface(gaussians, probability, cameras, visibility, (points, size))


def count_by_default(surface: Surface) -> Found:
    """Find centres (F, 3) and diameters (F,) by the product's default."""
    return _count(surface, CountConfig())


def count_by_method(method: Literal["template", "fruitnerf"], surface: Surface) -> Found:
    """Count by a published method of the product, given the same size; it samples its own points (the paper's eq.
    12)."""
    if surface.sample is None:
        return NONE
    return _count(surface, CountConfig(method=method, diameter=surface.sample[1].diameter))


def _count(surface: Surface, config: CountConfig) -> Found:
    """Return what the product counts; no fruit where it reports that a 0 is not a count."""
    try:
        counted = count_fruit(
            surface.gaussians,
            surface.probability,
            surface.cameras,
            config,
            label="fruit",
            visibility=surface.visibility,
        )
    except CountingError:
        return NONE
    return counted.centers, counted.diameters


def count_by_mass(surface: Surface) -> Found:
    """DBSCAN; the number of fruit in a cluster is its number of points relative to a typical cluster, split by
    k-means."""
    if surface.sample is None:
        return NONE
    points, diameter = surface.sample[0], surface.sample[1].diameter
    cluster = DBSCAN(eps=LINK * diameter, min_samples=LEAST).fit_predict(points.positions)
    sizes = np.bincount(cluster[cluster >= 0])
    if len(sizes) == 0:
        return NONE
    # Half of the points lie in clusters of at least this size: floaters are many clusters of few points.
    rising = np.sort(sizes)
    usual = float(rising[np.searchsorted(np.cumsum(rising), 0.5 * rising.sum())])
    centers = []
    for number in np.flatnonzero(sizes >= LEAST_MASS * usual):
        own = points.positions[cluster == number]
        parts = min(max(1, round(sizes[number] / usual)), len(own))
        centers.append(KMeans(parts, n_init=1, random_state=0).fit(own).cluster_centers_)
    found = np.concatenate(centers)
    return found, np.full(len(found), diameter)


def count_by_votes(surface: Surface) -> Found:
    """Votes for centres along the normals, sphere fits, non-maximum suppression; no candidate is rejected for its
    shape."""
    if surface.sample is None:
        return NONE
    points, size = surface.sample
    radius, surface_points = size.diameter / 2.0, SurfaceIndex.of(points, size.diameter)
    starts = vote(surface_points, radius, VOTE_SHARE)
    reaches, radii = np.full(len(starts), REACH * radius), np.full(len(starts), radius)
    spheres = fit_spheres(
        surface_points.cells, surface_points.normals, starts, reaches, radii, prior=radius, prior_sd=PRIOR_SD
    )
    chosen: list[int] = []
    for index in np.argsort(-spheres.support, kind="stable"):
        if spheres.support[index] < WEAKEST * spheres.support.max():
            break
        apart = np.linalg.norm(spheres.centers[chosen] - spheres.centers[index], axis=1)
        if (apart >= OVERLAP * (spheres.radii[chosen] + spheres.radii[index])).all():
            chosen.append(int(index))
    return spheres.centers[chosen], 2.0 * spheres.radii[chosen]


METHODS: Mapping[str, Callable[[Surface], Found]] = {
    "DBSCAN + mass ratio": count_by_mass,
    "plain centre voting": count_by_votes,
    "FruitNeRF's clustering": partial(count_by_method, "fruitnerf"),
    "paper's template method": partial(count_by_method, "template"),
    "ours": count_by_default,
}
"""By name."""
