"""Plain ways to count, for comparison: what fields use, on the same points and the same estimated size as ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from sklearn.cluster import DBSCAN, KMeans

from ..engine.config import CountConfig
from ..engine.counting.cluster import NEIGHBORS, OVERLAP, vote
from ..engine.counting.count import LARGEST_SCALE, SIZING_POINTS, count_fruit
from ..engine.counting.sample import SurfacePoints, sample_skin
from ..engine.counting.size import estimate_diameter
from ..engine.counting.sphere import REACH, fit_spheres, neighborhoods
from ..engine.counting.visibility import Visibility, see
from .simulated import Simulation

FloatArray = NDArray[np.float64]

LINK, LEAST = 0.15, 8
"""DBSCAN's ε, in diameters, and min_samples."""
LEAST_MASS = 0.15
"""A cluster with less than this share of a fruit's points is dropped."""
WEAKEST = 0.15
"""A sphere with less than this share of the best sphere's points is dropped."""


def ours(simulation: Simulation) -> tuple[FloatArray, FloatArray]:
    """Centres (F, 3) and diameters (F,) by the product's default."""
    counted = count_fruit(
        simulation.gaussians, simulation.probability, simulation.cameras, CountConfig(), label="fruit"
    )
    centers = np.array([fruit.center for fruit in counted.fruits]).reshape(-1, 3)
    return centers, np.array([fruit.diameter for fruit in counted.fruits])


def by_mass(simulation: Simulation) -> tuple[FloatArray, FloatArray]:
    """DBSCAN; a cluster holds as many fruit as it has points in those of a usual cluster, parted by k-means."""
    points, diameter = _surface(simulation)
    cluster = DBSCAN(eps=LINK * diameter, min_samples=LEAST).fit_predict(points.positions)
    sizes = np.bincount(cluster[cluster >= 0])
    if len(sizes) == 0:
        return np.zeros((0, 3)), np.zeros(0)
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


def by_votes(simulation: Simulation) -> tuple[FloatArray, FloatArray]:
    """Votes for centres along the normals, sphere fits, non-maximum suppression; nothing is rejected for its form."""
    points, diameter = _surface(simulation)
    tree, radius = cKDTree(points.positions), diameter / 2.0
    starts = vote(points, radius)
    near = neighborhoods(tree, starts, np.full(len(starts), REACH * radius), NEIGHBORS)
    spheres = fit_spheres(points, near, starts, np.full(len(starts), radius), prior_sd=0.2)
    chosen: list[int] = []
    for index in np.argsort(-spheres.support, kind="stable"):
        if spheres.support[index] < WEAKEST * spheres.support.max():
            break
        apart = np.linalg.norm(spheres.centers[chosen] - spheres.centers[index], axis=1)
        if (apart >= OVERLAP * (spheres.radii[chosen] + spheres.radii[index])).all():
            chosen.append(int(index))
    return spheres.centers[chosen], 2.0 * spheres.radii[chosen]


METHODS: Mapping[str, Callable[[Simulation], tuple[FloatArray, FloatArray]]] = {
    "DBSCAN + mass ratio": by_mass,
    "plain centre voting": by_votes,
    "ours": ours,
}
"""By name."""


def _surface(simulation: Simulation) -> tuple[SurfacePoints, float]:
    """What ours starts from: points of the skin of all that is taken for fruit, and the fruit's diameter."""
    gaussians, config = simulation.gaussians, CountConfig()
    chances = simulation.probability.double().numpy()
    visibility: Visibility = see(gaussians, simulation.cameras)
    seen = np.flatnonzero((chances >= config.threshold) & (visibility.weights > 0))
    typical = float(np.median(gaussians.scales.double().numpy()[seen].max(axis=1)))

    def skin(budget: int, largest: float) -> SurfacePoints:
        return sample_skin(gaussians, chances, visibility, seen, budget=budget, seed=config.seed, largest=largest)

    estimate = estimate_diameter(skin(SIZING_POINTS, 8.0 * typical), typical, seed=config.seed)
    assert estimate is not None
    return skin(config.sample_budget, LARGEST_SCALE * estimate.diameter), estimate.diameter
