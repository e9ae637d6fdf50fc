"""FruitNeRF's clustering (Meyer et al. 2024, "FruitNeRF: A Unified Neural Radiance Field based Fruit Counting
Framework"), built from its description with its published parameters, as a baseline.

Points are cleaned, thinned to one per voxel, and clustered by DBSCAN. Small clusters near each other are pieces of one
fruit and are merged; clusters of less than 0.3 template volumes are then discarded, and those of more than 0.9 are
split by agglomerative clustering into the k = 2 … 6 parts with the least Hausdorff distance to the aligned template.

The published lengths are in units of scenes whose fruit have other sizes; here they are in fruit diameters. Those of
its synthetic apple tree (voxel 0.001, ε and radius of cleaning 0.01, merging 0.04, template scaled by 0.7) are read
with a template of 0.08 at scale 1, an apple of 8 cm, because its file is not described. A voxel is then a 56th of a
diameter.
"""

from __future__ import annotations

from itertools import compress

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ...progress import Progress, silent
from ..evidence.candidates import SurfaceIndex
from ..evidence.claims import members
from ..evidence.cluster import Clusters
from ..evidence.surface_points import SurfacePoints
from .density import Density, dense_clusters
from .findings import Finding, clusters_of
from .parts import Cloud, best_split
from .template_shape import Template, ball

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

FRUIT = 0.7 * 0.08
"""Diameter of its apples, in units of its scene."""
VOXEL, LINK, MERGED = 0.001 / FRUIT, 0.01 / FRUIT, 0.04 / FRUIT
"""Side of the voxels, DBSCAN's ε (and radius of cleaning), and how far apart small clusters of one fruit are, all in
diameters."""
SURFACE_POINTS = 3 * np.pi * (LINK / VOXEL) ** 2
"""Voxels within ε of a point on a fruit whose surface is three voxels thick, as in its radiance field."""
CLEAN_SHARE, CORE_SHARE = 200 / SURFACE_POINTS, 100 / SURFACE_POINTS
"""Neighbours that a point needs to be kept (200) and min_samples (100), as shares of the typical number within ε."""
LEAST_VOLUME, SPLIT_VOLUME, MOST_PARTS = 0.3, 0.9, 6
"""In template volumes: below the first a cluster is discarded, above the second it is split; and the most parts."""


def cluster_as_fruitnerf(
    points: SurfacePoints, diameter: float, template: Template | None = None, *, progress: Progress = silent
) -> Clusters:
    """Cluster the points, of fruit of `diameter` scene units; template: the fruit's shape, a ball without one."""
    surface = SurfaceIndex.of(_thin_to_voxels(points, VOXEL * diameter), diameter)
    positions = surface.points.positions / diameter
    cloud = Cloud(positions, positions, template or ball())
    clusters = _merge_small(cloud, _cluster(positions))
    findings = []
    for number, index in enumerate(clusters):
        progress(number / len(clusters), f"comparing cluster {number + 1} of {len(clusters)} with the template")
        findings.append(_judge(cloud, index))
    return clusters_of(surface, diameter, findings)


def _judge(cloud: Cloud, index: IntArray) -> Finding:
    volume = cloud.volume(index)
    if volume < LEAST_VOLUME:
        return Finding.drop(index, f"its alpha shape has {volume:.2f} template volumes ({LEAST_VOLUME} is asked)")
    parts = best_split(cloud, index, MOST_PARTS) if volume > SPLIT_VOLUME else [cloud.part(index)]
    return Finding.keep(index, volume, parts)


def _thin_to_voxels(points: SurfacePoints, side: float) -> SurfacePoints:
    """Keep the first point in each voxel of `side` scene units."""
    return points.select(np.sort(np.unique(np.floor(points.positions / side), axis=0, return_index=True)[1]))


def _cluster(positions: FloatArray) -> list[IntArray]:
    """Return the points of each cluster; points with too few neighbours are removed first."""
    density = Density.of(positions, LINK)
    kept = np.flatnonzero(density.numbers >= CLEAN_SHARE * density.usual)
    return [kept[own] for own in dense_clusters(positions[kept], LINK, density, CORE_SHARE)]


def _merge_small(cloud: Cloud, clusters: list[IntArray]) -> list[IntArray]:
    """Return the clusters (C), with small ones whose centres lie near each other merged."""
    small = [cloud.volume(index) < LEAST_VOLUME for index in clusters]
    pieces = list(compress(clusters, small))
    if len(pieces) < 2:
        return clusters
    middles = np.stack([cloud.positions[index].mean(axis=0) for index in pieces])
    groups = [own[near] for own in _group_linked(middles) for near in _group_near(middles[own])]
    merged = [np.concatenate([pieces[piece] for piece in group]) for group in groups]
    return [index for index, is_small in zip(clusters, small, strict=True) if not is_small] + merged


def _group_linked(middles: FloatArray) -> list[IntArray]:
    """Group centres (C, 3) in chains of near ones; the pairs of all centres would not fit into memory."""
    pairs = cKDTree(middles).query_pairs(MERGED, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(len(middles),) * 2)
    count, labels = connected_components(graph, directed=False)
    return members(labels.astype(np.int64), count)


def _group_near(middles: FloatArray) -> list[IntArray]:
    """Group centres (C, 3) whose mean distance is at most that of pieces of one fruit."""
    if len(middles) == 1:
        return [np.zeros(1, np.int64)]
    labels = fcluster(linkage(middles, "average"), MERGED, criterion="distance").astype(np.int64)
    return members(labels - 1, int(labels.max()))
