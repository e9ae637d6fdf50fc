"""The paper's clustering (section 3.3): DBSCAN, density pruning, and splitting by a spherical template.

Clusters are compared with the template by the volume of their hull and by Hausdorff distance after alignment, as
FruitNeRF does: below 0.3 template volumes a cluster is too small, above 0.9 it is split into the 2 to 6 parts that fit
the template best. Every length is in fruit diameters, which the scene gives.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError, cKDTree
from sklearn.cluster import DBSCAN, KMeans

from ..progress import Progress, silent
from .cells import Cells
from .cluster import Clusters
from .sample import SurfacePoints
from .sphere import unit_directions, weighed

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LINK = 0.12
"""DBSCAN's ε in diameters."""
CORE_SHARE = 0.25
"""DBSCAN's min_samples and the pruning threshold, as a share of the median number of neighbours within ε."""
LEAST_VOLUME = 0.3
SPLIT_VOLUME = 0.9
MOST_PARTS = 6
TEMPLATE_POINTS = 300


def split_by_template(points: SurfacePoints, diameter: float, *, seed: int, progress: Progress = silent) -> Clusters:
    """Cluster the points and split each cluster into copies of a sphere of `diameter` scene units."""
    tree = cKDTree(points.positions)
    neighbors = tree.query_ball_point(points.positions, LINK * diameter, return_length=True)
    least = max(4, int(CORE_SHARE * np.median(neighbors)))
    dense = np.flatnonzero(neighbors >= least)
    components = np.full(len(points), -1, np.int64)
    if len(dense):
        components[dense] = DBSCAN(eps=LINK * diameter, min_samples=least).fit_predict(points.positions[dense])
    count = int(components.max(initial=-1)) + 1
    centers: list[FloatArray] = []
    owners = np.full(len(points), -1, np.int64)
    refusals: dict[int, str] = {count: "too thin to be part of any cluster"}
    for component in range(count):
        progress(component / count, f"fitting the template to cluster {component + 1} of {count}")
        index = np.flatnonzero(components == component)
        volume = hull_volume(points.positions[index]) / (np.pi / 6.0 * diameter**3)
        if volume < LEAST_VOLUME:
            refusals[component] = f"its hull has {volume:.2f} of a fruit's volume (at least {LEAST_VOLUME} is asked)"
            continue
        parts = split(points.positions[index], diameter, volume, seed)
        owners[index] = parts + len(centers)
        centers += [align(points.positions[index[parts == each]], diameter) for each in range(parts.max() + 1)]
    components[components < 0] = count
    places = np.array(centers).reshape(-1, 3)
    radii = np.full(len(places), diameter / 2.0)
    cells = Cells.of(points.positions, diameter)
    spheres = weighed(cells, points.normals[cells.index], places, radii, 0.1 * radii)
    owned = np.bincount(owners[owners >= 0], minlength=len(places))
    summed = np.bincount(owners[owners >= 0], points.probabilities[owners >= 0], minlength=len(places))
    likely = summed / np.maximum(owned, 1)
    return Clusters(points, spheres, owners, components, likely, refusals)


def hull_volume(positions: FloatArray) -> float:
    """Volume of the convex hull of (M, 3) points in cubed scene units; 0 for points in one plane."""
    try:
        return float(ConvexHull(positions).volume)
    except (QhullError, ValueError):
        return 0.0


def split(positions: FloatArray, diameter: float, volume: float, seed: int) -> IntArray:
    """(M,) part of each point: the number of parts, up to 6, whose points lie nearest to aligned templates.

    volume: the cluster's hull in template volumes; at most 0.9 is one fruit.
    """
    whole = np.zeros(len(positions), np.int64)
    if volume <= SPLIT_VOLUME:
        return whole
    best, least = whole, misfit(positions, whole, diameter)
    for count in range(2, min(MOST_PARTS, len(positions)) + 1):
        parts = KMeans(count, n_init=2, random_state=seed).fit_predict(positions).astype(np.int64)
        found = misfit(positions, parts, diameter)
        if found < least:
            best, least = parts, found
    return best


def misfit(positions: FloatArray, parts: IntArray, diameter: float) -> float:
    """Mean over parts of the Hausdorff distance to a template; its 95th percentile, so that no stray point rules."""
    template = 0.5 * diameter * unit_directions(TEMPLATE_POINTS)
    distances = []
    for each in range(parts.max() + 1):
        own = positions[parts == each]
        placed = align(own, diameter) + template
        there = cKDTree(placed).query(own)[0]
        back = cKDTree(own).query(placed)[0]
        distances.append(max(np.quantile(there, 0.95), np.quantile(back, 0.95)))
    return float(np.mean(distances))


def align(positions: FloatArray, diameter: float, rounds: int = 20) -> FloatArray:
    """(3,) centre of the template aligned to (M, 3) points: iterative closest points, for a sphere in closed form."""
    center = positions.mean(axis=0)
    for _ in range(rounds):
        outward = positions - center
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
        center = (positions - 0.5 * diameter * outward).mean(axis=0)
    return center
