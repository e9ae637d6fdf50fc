"""The paper's clustering (section 3.3): DBSCAN, density pruning, and splitting by a template of a fruit.

A cluster is compared with the template by the volume of its alpha shape and, after alignment, by Hausdorff distance. If
either differs, the cluster is split into the parts that fit best, and parts that still differ are split again, until no
split fits better. γ of a cluster is the number of templates aligned to it; a cluster is a single fruit, a small one, or
a compound. Every length is in fruit diameters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...progress import Progress, silent
from ..evidence.candidates import SurfaceIndex
from ..evidence.cluster import Clusters
from ..evidence.surface_points import SurfacePoints
from .density import Density, dense_clusters
from .findings import Finding, clusters_of
from .parts import Cloud, Part, best_split
from .registration import register
from .template_shape import Template, ball, cut_template

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LINK = 0.22
"""DBSCAN's ε in diameters."""
CORE_SHARE = 0.25
"""DBSCAN's min_samples, as a share of the typical number of neighbours within ε."""
THIN = 0.3
"""A cluster is pruned if half of its points have less than this share of the typical number of neighbours."""
SMALLEST_VOLUME, LEAST_VOLUME, SPLIT_VOLUME = 0.1, 0.3, 0.9
"""In template volumes: the least of a small fruit, the least of a single one, and the most of a single one (the last
two from FruitNeRF, Meyer et al. 2024, and so is the first, for its second real tree)."""
MOST_PARTS = 60
"""Parts that a cluster is split into at once, or as many as 0.3 template volumes each allow."""
MISMATCH = 0.2
"""A cluster whose points lie farther than this from the template is split, whatever its volume."""
SMALL_OFF = 0.12
"""Points of a small fruit lie on the template up to this distance; those of leaves and twigs do not."""
TYPICAL = (0.7, 1.2)
"""In volumes of a sphere, the volume of a fruit that is visible from most sides."""
BARE = 0.25
"""Largest distance of the sphere's points from those of a fruit that is visible from most sides."""
TRIED = 8
"""Number of single fruit of which the most typical becomes the template."""
FEWEST = 3
"""Number of single fruit below which the template is a sphere."""


def split_by_template(
    points: SurfacePoints, diameter: float, template: Template | None = None, *, progress: Progress = silent
) -> Clusters:
    """Cluster the points and align templates of `diameter` scene units to each cluster.

    template: the shape of the fruit; without one, the most typical single fruit of the scene.
    """
    surface = SurfaceIndex.of(points, diameter)
    positions = surface.points.positions / diameter
    density = Density.of(positions, LINK)
    clusters = dense_clusters(positions, LINK, density, CORE_SHARE)
    cloud = Cloud(positions, positions - 0.5 * surface.normals, ball())
    cloud = replace(cloud, template=template or typical_fruit(cloud, clusters))
    findings = []
    for number, index in enumerate(clusters):
        progress(number / len(clusters), f"laying the template onto cluster {number + 1} of {len(clusters)}")
        findings.append(judge(cloud, index, float(np.median(density.numbers[index])) / density.usual))
    return clusters_of(surface, diameter, findings)


def judge(cloud: Cloud, index: IntArray, dense: float) -> Finding:
    """Judge the points at `index`; dense: the typical number of their neighbours, relative to the scene."""
    if dense < THIN:
        return Finding.drop(
            index, f"its points lie thinner than fruit: {dense:.2f} of the usual density ({THIN} is asked)"
        )
    volume = cloud.volume(index)
    if volume < SMALLEST_VOLUME:
        return Finding.drop(index, f"its alpha shape has {volume:.2f} template volumes ({SMALLEST_VOLUME} is asked)")
    if volume >= LEAST_VOLUME:
        return Finding.keep(index, volume, fit_parts(cloud, index))
    small = cloud.part(index, small=True)
    if small.fit.off > SMALL_OFF:
        return Finding.drop(
            index,
            f"its alpha shape has {volume:.2f} template volumes and its points are {small.fit.off:.2f} diameters off "
            f"the aligned template (a small fruit's at most {SMALL_OFF})",
        )
    return Finding.keep(index, volume, [small])


def fit_parts(cloud: Cloud, index: IntArray) -> list[Part]:
    """Find the fruit that the points at `index` consist of."""
    whole, volume = cloud.part(index), cloud.volume(index)
    if volume <= SPLIT_VOLUME and whole.fit.off <= MISMATCH:
        return [whole]
    parts = best_split(cloud, index, min(MOST_PARTS, math.ceil(volume / LEAST_VOLUME)))
    if len(parts) == 1:
        return parts
    return [each for part in parts for each in (fit_parts(cloud, part.index) if part.fit.off > MISMATCH else [part])]


def typical_fruit(cloud: Cloud, clusters: Sequence[IntArray]) -> Template:
    """The single fruit whose shape is nearest to the others', among the most visible ones; a sphere if there are none.

    cloud: with a sphere as its template, which decides what is a single fruit.
    """
    sized = [index for index in clusters if TYPICAL[0] < cloud.volume(index) < TYPICAL[1]]
    single = [part for part in map(cloud.part, sized) if part.fit.off < MISMATCH and part.fit.bare < BARE]
    whole = sorted(single, key=lambda part: part.fit.bare)[:TRIED]
    if len(whole) < FEWEST:
        return cloud.template
    shapes = [cut_template(cloud.positions[part.index]) for part in whole]
    apart = [
        sum(register(other.points, shape, np.zeros(3)).hausdorff for other in shapes if other is not shape)
        for shape in shapes
    ]
    return shapes[int(np.argmin(apart))]
