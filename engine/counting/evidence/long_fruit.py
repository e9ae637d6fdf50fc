"""Long fruit: several spheres along one body, without a neck between them, are one fruit.

Between two round fruit that touch the surface narrows to a point; along a cucumber it does not. If most spheres of a
scene have such a neighbour, its fruit are long, and spheres are joined to bodies of about the same length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..geometry.sphere import Spheres

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NEAREST, FARTHER = 1.5, 2.0
"""Diameters between the centres of spheres that may be one body: of the first links, and of later ones."""
FULL, WIDE = (0.6, 0.35), (0.6, 0.5)
"""Least number of points half way between two centres, over that at the centres, and their least median distance from
the line between these, in radii: of the first links, and of later ones."""
MIDDLE, END = 0.1, 0.1
"""Half lengths, in distances of the centres, of the parts of the body that are compared."""
ASIDE = 1.3
"""Radii from the line within which points belong to the body."""
FEWEST = 4
"""Points half way between two centres from which they can be judged."""
STRAIGHT = -0.8
"""Largest cosine between the two links of a sphere."""
MOSTLY, NEARLY_ALL, MANY, ENOUGH = 0.5, 0.75, 6, 3
"""Share of linked spheres from which the fruit of a scene are long: of MANY spheres, and of fewer; fewer than ENOUGH
say nothing."""
TYPICAL, LONGEST, SIDE = 75.0, 1.4, 0.5
"""Percentile of the lengths after the first links that is taken for the usual length, what a body may be at most of it,
and how far in diameters its spheres may lie off its axis."""


@dataclass(frozen=True, eq=False)
class Parts:
    """The spheres that long fruit consist of. centers: (S, 3); radii: (S,); owners: (S,) index of their fruit."""

    centers: FloatArray
    radii: FloatArray
    owners: IntArray

    def keep(self, numbers: IntArray) -> Parts:
        """Keep the parts of fruit that stay; numbers: (F,) their new index, -1 for those that do not."""
        own = numbers[self.owners]
        return Parts(self.centers[own >= 0], self.radii[own >= 0], own[own >= 0])

    def shares(self, places: FloatArray) -> FloatArray:
        """(C,) how much of a fruit one sphere at each of the places (C, 3) is: of the fruit with the nearest part."""
        if len(self.owners) == 0:
            return np.ones(len(places))
        sizes = np.bincount(self.owners)[self.owners]
        shares: FloatArray = 1.0 / sizes[cKDTree(self.centers).query(places)[1]]
        return shares


@dataclass(frozen=True, eq=False)
class Link:
    """Two spheres that may be one body. full, wide: see FULL and WIDE; length: between the centres, scene units."""

    one: int
    other: int
    length: float
    full: float
    wide: float


def find_bodies(points: FloatArray, spheres: Spheres) -> IntArray | None:
    """Find the number (F,) of the body that each sphere is part of; None if the fruit are not long. points: (P, 3) of
    their surfaces."""
    centers, radii = spheres.centers, spheres.radii
    if len(centers) < ENOUGH:
        return None
    diameter = float(2.0 * radii.mean())
    links = _find_links(points, centers, radii, FARTHER * diameter)
    first = [
        link for link in links if link.length <= NEAREST * diameter and link.full >= FULL[0] and link.wide >= WIDE[0]
    ]
    kept = _select_straight(centers, first)
    linked = len({end for link in kept for end in (link.one, link.other)})
    if linked < len(centers) * (MOSTLY if len(centers) >= MANY else NEARLY_ALL):
        return None
    numbers = _find_components(len(centers), kept)
    lengths = np.array([_extent(centers[numbers == number])[0] for number in range(numbers.max() + 1)])
    longest = LONGEST * float(np.percentile(lengths[lengths > 0.0], TYPICAL))
    later = [link for link in links if link.full >= FULL[1] and link.wide >= WIDE[1]]
    for link in sorted(later, key=lambda link: -link.full):
        one, other = numbers[link.one], numbers[link.other]
        together = (numbers == one) | (numbers == other)
        length, aside = _extent(centers[together])
        if one != other and length <= longest and aside <= SIDE * diameter:
            numbers[together] = one
    joined: IntArray = np.unique(numbers, return_inverse=True)[1].astype(np.int64)
    return joined


def join_bodies(spheres: Spheres, numbers: IntArray) -> tuple[Spheres, FloatArray, Parts]:
    """Return the bodies as spheres of equal volume, their half axes (B, 3, 3) in radii, rows longest first, and their
    parts.

    numbers: (F,) the body of each sphere. A body is a cylinder with round ends; its other qualities are the means of
    its spheres.
    """
    merged, axes = [], []
    for number in range(numbers.max() + 1):
        own = spheres.select(numbers == number)
        along, center, length = _axis(own.centers)
        width = float(own.radii.mean())
        radius = (width**3 + 0.75 * width**2 * length) ** (1.0 / 3.0)
        means = {name: getattr(own, name).mean(axis=0) for name in _QUALITIES}
        merged.append(means | {"centers": center, "radii": radius, "support": own.support.sum()})
        axes.append(_frame(along) * [[(0.5 * length + width) / radius], [width / radius], [width / radius]])
    names = merged[0].keys()
    together = Spheres(**{name: np.array([each[name] for each in merged]) for name in names})
    return together, np.array(axes), Parts(spheres.centers, spheres.radii, numbers)


_QUALITIES = ("radius_sds", "shell", "coverage", "thinness", "residual", "agreement")


def _find_links(points: FloatArray, centers: FloatArray, radii: FloatArray, reach: float) -> list[Link]:
    """Find all pairs of spheres within reach of each other that have points between them."""
    tree, links = cKDTree(points), list[Link]()
    for one, other in sorted(cKDTree(centers).query_pairs(reach)):
        step = centers[other] - centers[one]
        length, radius = float(np.linalg.norm(step)), float(radii[[one, other]].mean())
        around = np.hypot(ASIDE * radius, (0.5 + END) * length)
        near = points[tree.query_ball_point((centers[one] + centers[other]) / 2.0, around)] - centers[one]
        along = near @ step / length**2
        aside = np.linalg.norm(near - along[:, None] * step, axis=1) / radius
        body = aside < ASIDE
        middle = body & (np.abs(along - 0.5) < MIDDLE)
        ends = body & (np.minimum(np.abs(along), np.abs(along - 1.0)) < END)
        if middle.sum() >= FEWEST:
            full = float(middle.sum() / max(ends.sum() / 2.0, 1.0))
            links.append(Link(one, other, length, full, float(np.median(aside[middle]))))
    return links


def _select_straight(centers: FloatArray, links: Sequence[Link]) -> list[Link]:
    """Select links, shortest first, so that all links of a sphere lie on one line."""
    kept, ends = list[Link](), dict[int, list[int]]()
    for link in sorted(links, key=lambda link: link.length):
        pairs = ((link.one, link.other), (link.other, link.one))
        if all(
            _cosine(centers[to] - centers[at], centers[other] - centers[at]) < STRAIGHT
            for at, to in pairs
            for other in ends.get(at, ())
        ):
            kept.append(link)
            for at, to in pairs:
                ends.setdefault(at, []).append(to)
    return kept


def _find_components(count: int, links: Sequence[Link]) -> IntArray:
    rows, columns = ([getattr(link, name) for link in links] for name in ("one", "other"))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    numbers: IntArray = connected_components(graph, directed=False)[1].astype(np.int64)
    return numbers


def _axis(centers: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Of centres (n, 3): the direction (3,) in which they lie, the middle (3,) between the outermost, and the distance
    of these."""
    middle = centers.mean(axis=0)
    if len(centers) == 1:
        return np.array([0.0, 0.0, 1.0]), middle, 0.0
    along = np.linalg.svd(centers - middle)[2][0]
    places = (centers - middle) @ along
    return along, middle + along * (places.max() + places.min()) / 2.0, float(np.ptp(places))


def _extent(centers: FloatArray) -> tuple[float, float]:
    """The distance of the outermost of centres (n, 3), and the largest distance from their line."""
    along, middle, length = _axis(centers)
    offsets = centers - middle
    return length, float(np.linalg.norm(offsets - np.outer(offsets @ along, along), axis=1).max())


def _frame(along: FloatArray) -> FloatArray:
    """(3, 3) right-handed rows, the first along."""
    helper = np.eye(3)[int(np.abs(along).argmin())]
    second = np.cross(along, helper)
    second /= np.linalg.norm(second)
    return np.stack([along, second, np.cross(along, second)])


def _cosine(one: FloatArray, other: FloatArray) -> float:
    return float(one @ other / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-12))
