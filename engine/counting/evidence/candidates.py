"""Spheres that may be fruit: votes for centres, robust fits, and a greedy choice of those that explain the points."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.cells import Cells, choose_apart
from ..geometry.overlaps import Overlaps
from ..geometry.sphere import REACH, Spheres, fit_spheres
from .claims import claim
from .size import FruitSize
from .surface_points import SurfacePoints
from .visibility import Picture, ViewEvidence, gather_view_evidence
from .vote_kernels import average_points, turn_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CELL = 0.6
"""Side of the cells of points, in mean radii."""
NORMAL_REACH, NORMAL_NEIGHBORS = 0.4, 32
"""The normal of a point is estimated from points within this many mean radii, and at most this many."""
VOTE_STEP = 0.3
"""Logarithm of the ratio between the radii at which points vote."""
VOTED = 2.2
"""Radii vote within this many deviations of log radius about the mean one."""
LEAST_VOTES, LEAST_VOTE_SHARE = 2.0, 0.01
"""A centre has at least this many votes, and this share of the votes of the densest tenth."""
LEAST_THINNESS, LEAST_COVERAGE, LEAST_SHELL, LEAST_SUPPORT = 0.03, 0.05, 0.4, 0.015
LEAST_AGREEMENT, LEAST_SOLIDITY, LEAST_PROBABILITY = 0.2, 0.08, 0.03
MOST_OFF = 3.5
"""Limits that no fruit exceeds (deviations of log diameter): spheres beyond them are not considered."""
RESIDUAL = 0.05
"""Radii off the surface at which the merit of a sphere falls."""
SAME = 0.08
"""Spheres whose centres and radii differ by less than this many radii are one."""
ROUND = 0.3
"""Spheres covered on more than this share show how many points a whole fruit has."""
OVERLAP = 0.8
"""The centres of two fruit are at least this many sums of their radii apart."""
LEAST_FREE = 0.5
"""A sphere keeps at least this share of its points after better spheres have claimed theirs."""


@dataclass(frozen=True, eq=False)
class SurfaceIndex:
    """P surface points in the order of their cells, with normals (P, 3) smoothed over their neighbours."""

    points: SurfacePoints
    cells: Cells
    normals: FloatArray

    @classmethod
    def of(cls, points: SurfacePoints, diameter: float) -> SurfaceIndex:
        """Sort the points into cells and smooth their normals; diameter: of a fruit, scene units."""
        cells = Cells.of(points.positions, CELL * diameter / 2.0, points.turns)
        ordered, normals = points.select(cells.index), np.empty_like(points.normals)
        reach = NORMAL_REACH * diameter / 2.0
        turn_normals(cells.table, ordered.normals, ordered.directions, reach, NORMAL_NEIGHBORS, normals)
        return cls(ordered, cells, normals)


@dataclass(frozen=True, eq=False)
class Candidates:
    """C spheres that may be fruit and that overlap little.

    shares: (C,) points on each relative to its surface, in those of a typical whole fruit; free: (C,) share of its
    points that no better sphere claimed; owners: (P,) sphere of each point, -1 for none.
    """

    spheres: Spheres
    view_evidence: ViewEvidence
    shares: FloatArray
    free: FloatArray
    owners: IntArray

    def __len__(self) -> int:
        return len(self.spheres)


def find_candidates(
    surface: SurfaceIndex, size: FruitSize, pictures: Sequence[Picture], threshold: float
) -> Candidates:
    """Spheres that explain the points, whether they look like fruit or not."""
    radius = size.diameter / 2.0
    steps = int(VOTED * size.spread / VOTE_STEP)
    radii = radius * np.exp(VOTE_STEP * np.arange(-steps, steps + 1))
    voted = [vote(surface, each) for each in radii]
    starts, start_radii = np.concatenate(voted), np.repeat(radii, [len(each) for each in voted])
    spheres = fit_spheres(
        surface.cells, surface.normals, starts, REACH * start_radii, start_radii,
        prior=radius, prior_sd=size.spread, same=SAME,
    )  # fmt: skip
    view_evidence = gather_view_evidence(pictures, spheres.centers, spheres.radii, threshold)
    off = np.log(2.0 * np.maximum(spheres.radii, 1e-12) / size.diameter) / size.spread
    shares = support_shares(spheres)
    possible = (
        (spheres.thinness > LEAST_THINNESS)
        & (spheres.coverage > LEAST_COVERAGE)
        & (spheres.shell > LEAST_SHELL)
        & (spheres.agreement > LEAST_AGREEMENT)
        & (shares > LEAST_SUPPORT)
        & (view_evidence.solidity > LEAST_SOLIDITY)
        & (view_evidence.probabilities > LEAST_PROBABILITY)
        & (np.abs(off) < MOST_OFF)
    )
    # A sphere over two fruit explains more points than one of them, but has an unlikely size, misses the surface, and
    # its points face elsewhere. One in the gap between fruit is transparent in the views.
    fitting = np.maximum(spheres.agreement, 0.0) ** 2 * np.exp(-0.5 * (spheres.residual / RESIDUAL) ** 2)
    merit = np.exp(-0.5 * off**2) * fitting * view_evidence.solidity * view_evidence.probabilities
    chosen, owners, free = cover(surface, spheres.select(possible), merit[possible])
    index = np.flatnonzero(possible)[chosen]
    return Candidates(spheres.select(index), view_evidence.select(index), shares[index], free, owners)


def vote(surface: SurfaceIndex, radius: float, least_share: float = LEAST_VOTE_SHARE) -> FloatArray:
    """(C, 3) peaks of the density of the centres p − r·n that the points vote for, at least 0.35 r apart; least_share:
    relative to the votes of the densest tenth."""
    cells = Cells.of(surface.points.positions - radius * surface.normals, 0.35 * radius, surface.points.turns)
    density = cells.numbers(cells.positions, np.full(len(surface.points), 0.25 * radius))
    least = max(LEAST_VOTES, least_share * float(np.quantile(density, 0.9)))
    order = np.lexsort((cells.turns, -density))
    peaks = choose_apart(cells.table, np.full(len(order), radius), order[density[order] >= least], 0.35)
    centers = np.empty((len(peaks), 3))
    average_points(cells.table, cells.positions[peaks], 0.3 * radius, centers)
    return centers


def support_shares(spheres: Spheres) -> FloatArray:
    """(C,) points on each sphere relative to its surface, in those of a typical whole fruit (upper quartile of round
    fits)."""
    density = spheres.support / np.maximum(spheres.radii, 1e-12) ** 2
    round_fits = density[(spheres.shell > 0.5) & (spheres.coverage > ROUND)]
    whole = np.quantile(round_fits, 0.75) if len(round_fits) else density.max(initial=1.0)
    return density / max(float(whole), 1e-12)


def cover(surface: SurfaceIndex, spheres: Spheres, merit: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Choose spheres greedily by merit (C,) times the points that no better sphere has claimed.

    Returns which are chosen (F,), the owner of each point (P,), and the share of its points that each kept (F,).
    """
    claims = claim(surface.cells, surface.normals, spheres.centers, spheres.radii)
    owners = np.full(len(surface.points), -1, np.int64)
    own = [claims.value(index, owners)[0] for index in range(len(spheres))]
    heap = [(-own[index] * spheres.shell[index] * merit[index], index) for index in range(len(spheres))]
    heapq.heapify(heap)
    chosen, free = list[int](), list[float]()
    overlaps = Overlaps.of(spheres.centers, spheres.radii, OVERLAP)
    while heap:
        score, index = heapq.heappop(heap)
        left, inside = claims.value(index, owners)
        if left <= 0.0 or left < LEAST_FREE * own[index]:
            continue
        now = -(left * left / max(left + inside, 1e-9)) * merit[index]
        if now > 0.98 * score and heap and now > heap[0][0]:
            heapq.heappush(heap, (now, index))
            continue
        if overlaps.any_chosen(index):
            continue
        overlaps.chosen[index] = True
        claims.take(index, len(chosen), owners)
        chosen.append(index)
        free.append(left / own[index])
    return np.array(chosen, np.int64), owners, np.array(free)
