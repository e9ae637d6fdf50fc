"""The description of each fruit: size, visibility, colour and Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ...splatting.gaussians import Gaussians
from ..evidence.claims import members
from ..evidence.cluster import Clusters
from ..evidence.visibility import ViewEvidence
from ..fruit import NO_TREE, Fruit, FruitCount, FruitKind, Tree
from ..regions.row import Row

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SMALL = 0.6
"""A fruit below this many mean diameters has the kind "small"."""
MEMBER_REACH = 1.3
"""Radii around the centre of a fruit within which Gaussians belong to it."""
ASKED = 1.001 * MEMBER_REACH
"""Radii within which Gaussians are searched; larger than the reach, so that rounding leaves none out."""


def describe(
    gaussians: Gaussians,
    seen: IntArray,
    clusters: Clusters,
    numbers: IntArray,
    compound: NDArray[np.bool_],
    view_evidence: ViewEvidence,
    label: str,
) -> list[Fruit]:
    """The F fruit, in ascending order of id.

    seen: Gaussians that may be fruit; numbers, compound: (F,) id of each sphere and whether it shares its cluster with
    another; view_evidence: of the F spheres.
    """
    spheres, colors = clusters.spheres, point_colors(gaussians, clusters)
    mean = float(2.0 * spheres.radii.mean()) if len(spheres) else 0.0
    means = gaussians.means.detach().double().cpu().numpy()[seen]
    near = members(_owners(means, clusters), len(spheres))
    own = members(clusters.owners, len(spheres))
    shades = [colors[each] for each in own]
    for index in (index for index, each in enumerate(own) if len(each) == 0):
        around = _select_around(near[index], means, spheres.centers[index])
        shades[index] = colors_of(gaussians, seen[around])
    fruits = []
    for index in np.argsort(numbers):
        diameter, shown = float(2.0 * spheres.radii[index]), float(view_evidence.visible_fractions[index])
        kind: FruitKind = "compound-part" if compound[index] else "single"
        fruits.append(
            Fruit(
                id=int(numbers[index]),
                label=label,
                center=spheres.centers[index],
                diameter=diameter,
                diameter_sd=float(2.0 * spheres.radius_sds[index]),
                volume=float(np.pi / 6.0 * diameter**3),
                axes=0.5 * diameter * (np.eye(3) if clusters.axes is None else clusters.axes[index]),
                probability=float(clusters.probabilities[index]),
                visible_fraction=None if np.isnan(shown) else shown,
                views=int(view_evidence.views[index]),
                color=shades[index].mean(axis=0).round().astype(np.uint8),
                kind="small" if index in clusters.small or diameter < SMALL * mean else kind,
                members=seen[near[index]],
            )
        )
    return fruits


def _select_around(near: IntArray, means: FloatArray, center: FloatArray) -> IntArray:
    """Select the Gaussians of a fruit, `near` (M,) among means (N, 3); the one nearest to its centre if it has none."""
    return near if len(near) else np.linalg.norm(means - center, axis=1).argmin(keepdims=True)


def place_fruit(counted: FruitCount, lying: Sequence[bool | None], row: Row | None) -> FruitCount:
    """The fruit with their position in the scene: on the ground or not, and on which tree."""
    numbers = [NO_TREE] * counted.count if row is None else row.numbers.tolist()
    fruits = [
        replace(fruit, fallen=fallen, tree=None if number == NO_TREE else number)
        for fruit, fallen, number in zip(counted.fruits, lying, numbers, strict=True)
    ]
    places = () if row is None else row.places
    trees = [Tree(number, place, numbers.count(number)) for number, place in enumerate(places, start=1)]
    return replace(counted, fruits=fruits, trees=trees)


def point_colors(gaussians: Gaussians, clusters: Clusters) -> FloatArray:
    """(P, 3) sRGB in 0…255 of the points of the clusters: the base colours of their Gaussians."""
    return colors_of(gaussians, clusters.points.gaussians)


def colors_of(gaussians: Gaussians, index: IntArray) -> FloatArray:
    """(K, 3) sRGB in 0…255 of the Gaussians at `index` (K,): their base colours."""
    colors: FloatArray = 255.0 * gaussians.base_colors.detach().double().cpu().numpy()[index]
    return colors


def _owners(means: FloatArray, clusters: Clusters) -> IntArray:
    """(N,) index of the fruit in or near which each mean (N, 3) lies; -1 for none."""
    if clusters.parts is None:
        return nearest_sphere(means, clusters.spheres.centers, clusters.spheres.radii)
    parts = clusters.parts
    return np.append(parts.owners, -1)[nearest_sphere(means, parts.centers, parts.radii)]


def nearest_sphere(means: FloatArray, centers: FloatArray, radii: FloatArray) -> IntArray:
    """(N,) index of the sphere in or near which each mean (N, 3) lies (MEMBER_REACH), the relatively nearest; -1 for
    none."""
    owners, best = np.full(len(means), -1, np.int64), np.full(len(means), MEMBER_REACH)
    tree = cKDTree(means)
    for index, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        near = np.array(tree.query_ball_point(center, ASKED * radius), np.int64)
        relative = np.linalg.norm(means[near] - center, axis=1) / radius
        closer = relative < best[near]
        owners[near[closer]], best[near[closer]] = index, relative[closer]
    return owners
