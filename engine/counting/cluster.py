"""Fruit among surface points: votes for centres, sphere fits, greedy choice, rejection of what is no fruit."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..progress import Progress, silent
from .sample import SurfacePoints, turn_towards
from .sphere import CORE, REACH, Spheres, fit_spheres, neighborhoods, on_sphere
from .visibility import Looks, Picture, look_at

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

VOTE_RADII = (0.7, 1.0, 1.35)
"""Radii at which points vote, in mean radii."""
VOTERS = 20_000
NEIGHBORS = 384
LINK = 0.15
"""Points nearer to each other than this, in mean diameters, belong to one cluster."""
LEAST_THINNESS = 0.15
LEAST_COVERAGE = 0.10
LEAST_SHELL = 0.5
LEAST_SUPPORT = 0.10
"""A fruit has at least this share of the points of a typical fruit of its size (the upper quartile of all fits)."""
SHEET_THINNESS = 0.2
SHEET_RESIDUAL = 1.12
"""A fit thinner than the one and with more than the other times the usual residual is a curled leaf, not a cap."""
LEAST_SOLIDITY = 0.3
"""A fruit stops at least this share of the looks at its disc that nothing in front stops."""
LEAST_PROBABILITY = 0.05
"""Least mean probability of what the views show of a fruit; its neighbours' leaves bleed into small ones."""
SOLIDITY_WEIGHT, COVERAGE_WEIGHT, SHAPE_BIAS = 8.0, 11.0, 8.3
"""Of the logistic that weighs a sphere's form; fitted by hand to Gaussians trained on generated orchards."""
LEAST_SHAPE = 0.7
"""Least probability of a fruit by its form."""
SUREST = 0.5
"""The surest tenth of a fruit's points is at least this share of the threshold probable."""
OVERLAP = 0.8
"""Two fruit's centres are at least this many sums of their radii apart."""
FIT_SD = 0.1
"""Deviation of log radius of single free fits to fruit of one size."""
LEAST_FREE = 0.5
"""A fruit keeps at least this share of its points once better fruit have taken theirs."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """What became of the surface points.

    positions: (P, 3); spheres: the F accepted fruit; owners: (P,) index of the sphere each point belongs to, -1 none;
    components: (P,) index of the connected cluster a point is in; probabilities: (F,) that a sphere is a fruit of the
    prompt; refusals: why the best sphere of a cluster without fruit was refused, by cluster.
    """

    positions: FloatArray
    spheres: Spheres
    owners: IntArray
    components: IntArray
    probabilities: FloatArray
    refusals: Mapping[int, str]

    def refusal(self, component: int) -> str:
        """Why a cluster holds no fruit."""
        return self.refusals.get(component, "its points face no common centre")


def find_fruit(
    points: SurfacePoints,
    diameter: float,
    spread: float,
    pictures: Sequence[Picture],
    threshold: float,
    *,
    progress: Progress = silent,
) -> Clusters:
    """Find the spheres that explain the points and that the views do not see through.

    diameter: mean fruit diameter in scene units; spread: standard deviation of log diameter between fruit; threshold:
    probability that the surest points of a fruit come near, while its other points may be fainter.
    """
    radius, prior_sd = diameter / 2.0, size_sd(spread)
    tree = cKDTree(points.positions)
    progress(0.0, "finding normals")
    points = with_local_normals(points, tree, 0.2 * diameter)
    progress(0.3, "voting for centres")
    radii = np.array(
        [factor * radius for factor in VOTE_RADII if abs(np.log(factor)) < 2.2 * prior_sd or factor == 1.0]
    )
    starts = [vote(points, each) for each in radii]
    centers, start_radii = np.concatenate(starts), np.repeat(radii, [len(each) for each in starts])
    progress(0.5, f"fitting {len(centers)} spheres")
    near = neighborhoods(tree, centers, REACH * start_radii, NEIGHBORS)
    spheres = fit_spheres(points, near, centers, np.full(len(centers), radius), prior_sd=prior_sd)
    progress(0.8, "choosing among the fits")
    looks = look_at(pictures, spheres.centers, spheres.radii)
    passed = plausible(spheres, looks, diameter, prior_sd)
    merit = merits(spheres, looks, diameter, prior_sd)
    chosen, owners = cover(points, tree, spheres.select(passed), merit[passed])
    components = connected(points, LINK * diameter)
    refusals = refuse(spheres, looks, components[tree.query(spheres.centers)[1]], diameter) if len(spheres) else {}
    judged = judge(points, chosen, owners, look_at(pictures, chosen.centers, chosen.radii))
    kept = (judged.shape > LEAST_SHAPE) & (judged.surest > SUREST * threshold)
    for index in np.flatnonzero(~kept):
        home = int(np.bincount(components[owners == index]).argmax())
        refusals[home] = (
            f"a sphere looks {judged.shape[index]:.0%} like fruit, its surest points {judged.surest[index]:.2f}"
        )
    numbers = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    likely = judged.shape[kept] * judged.surest[kept]
    return Clusters(points.positions, chosen.select(kept), numbers[owners], components, likely, refusals)


@dataclass(frozen=True, eq=False)
class Judgement:
    """What speaks for F spheres. shape: (F,) probability of a fruit by its form; surest: (F,) probability of the prompt
    that a tenth of the points exceed."""

    shape: FloatArray
    surest: FloatArray


def judge(points: SurfacePoints, spheres: Spheres, owners: IntArray, looks: Looks) -> Judgement:
    """Weigh F spheres by what the views see of them and by their points' probabilities; owners: (P,).

    Half-leaf phantoms are seen through and covered from few directions. Solidity is relative to that of the scene's
    well covered spheres, because it depends on how opaque training made the Gaussians.
    """
    well = looks.solidity[spheres.coverage > 0.5]
    usual = float(np.median(well)) if len(well) else 1.0
    score = SOLIDITY_WEIGHT * looks.solidity / max(usual, 0.1) + COVERAGE_WEIGHT * spheres.coverage - SHAPE_BIAS
    surest = [np.quantile(points.probabilities[owners == index], 0.9) for index in range(len(spheres))]
    return Judgement(1.0 / (1.0 + np.exp(-score)), np.array(surest))


def size_sd(spread: float) -> float:
    """Deviation of log diameter between fruit, from that between single fits, which also err."""
    return float(np.clip(np.sqrt(max(spread**2 - FIT_SD**2, 0.0)), 0.1, 0.35))


def with_local_normals(points: SurfacePoints, tree: cKDTree, reach: float, neighbors: int = 32) -> SurfacePoints:
    """Replace each normal by the flat axis of its neighbours' scatter, where that is flat, turned to the cameras."""
    distance, index = tree.query(points.positions, k=min(neighbors, len(points)), distance_upper_bound=reach)
    normals = points.normals.copy()
    padded = np.vstack([points.positions, np.zeros(3)])
    for rows in (slice(start, start + 20_000) for start in range(0, len(points), 20_000)):
        weight = np.isfinite(distance[rows]).astype(np.float64)[:, :, None]
        local = padded[index[rows]]
        count = weight.sum(axis=1)
        offset = (local - (local * weight).sum(axis=1, keepdims=True) / count[:, None]) * weight
        values, axes = np.linalg.eigh(np.einsum("pki,pkj->pij", offset, offset) / count[:, :, None])
        flat = (count[:, 0] >= 8) & (values[:, 0] < 0.5 * values[:, 1])
        turned = turn_towards(axes[:, :, 0], points.directions[rows])
        # The Gaussian's own axis and the scatter's are two measurements of one normal.
        own = normals[rows]
        mixed = own + np.where((np.einsum("pi,pi->p", own, turned) > 0)[:, None], turned, turned - own)
        mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)
        normals[rows] = np.where(flat[:, None], mixed, own)
    return SurfacePoints(points.positions, normals, points.gaussians, points.probabilities, points.directions)


def vote(points: SurfacePoints, radius: float) -> FloatArray:
    """(C, 3) peaks of the density of the centres p − r·n that the points vote for, at least 0.35 r apart."""
    step = max(1, len(points) // VOTERS)
    votes = points.positions[::step] - radius * points.normals[::step]
    tree = cKDTree(votes)
    density = tree.query_ball_point(votes, 0.25 * radius, return_length=True)
    least = max(4.0, 0.05 * float(np.quantile(density, 0.9)))
    taken = np.zeros(len(votes), bool)
    peaks: list[int] = []
    for index in np.argsort(-density, kind="stable"):
        if density[index] < least:
            break
        if not taken[index]:
            peaks.append(int(index))
            taken[tree.query_ball_point(votes[index], 0.35 * radius)] = True
    near = neighborhoods(tree, votes[peaks], np.full(len(peaks), 0.3 * radius), 64)
    weight = (near >= 0)[:, :, None]
    return (votes[near] * weight).sum(axis=1) / np.maximum(weight.sum(axis=1), 1)


def plausible(spheres: Spheres, looks: Looks, diameter: float, prior_sd: float) -> NDArray[np.bool_]:
    """(C,) whether each sphere is round, covered, hollow, opaque and well supported enough for a fruit."""
    off_size = np.abs(np.log(2.0 * np.maximum(spheres.radii, 1e-12) / diameter)) / prior_sd
    shares = support_shares(spheres)
    return (
        (spheres.thinness > LEAST_THINNESS)
        & (spheres.coverage > LEAST_COVERAGE)
        & (spheres.shell > LEAST_SHELL)
        & (shares > LEAST_SUPPORT)
        & (off_size < 3.5)
        & (looks.solidity > LEAST_SOLIDITY)
        & (looks.probabilities > LEAST_PROBABILITY)
        & ~sheets(spheres)
    )


def merits(spheres: Spheres, looks: Looks, diameter: float, prior_sd: float) -> FloatArray:
    """(C,) how good each sphere is beside the number of points it explains.

    A sphere over two fruit explains more points than one of them, but is of an unlikely size; one in the gap between
    fruit is seen through.
    """
    likely = np.exp(-0.5 * (np.log(2.0 * spheres.radii / diameter) / prior_sd) ** 2)
    return likely * looks.solidity * looks.probabilities


def sheets(spheres: Spheres) -> NDArray[np.bool_]:
    """(C,) whether each sphere lies on a sheet: thin, and off the surface by more than well covered spheres are."""
    well = spheres.residual[(spheres.coverage > 0.5) & (spheres.shell > LEAST_SHELL)]
    usual = float(np.median(well)) if len(well) else np.inf
    return (spheres.thinness < SHEET_THINNESS) & (spheres.residual > SHEET_RESIDUAL * usual)


def support_shares(spheres: Spheres) -> FloatArray:
    """(C,) points on each sphere for its surface, in those of a typical whole fruit (upper quartile of round fits)."""
    density = spheres.support / np.maximum(spheres.radii, 1e-12) ** 2
    round_fits = density[(spheres.shell > LEAST_SHELL) & (spheres.coverage > 0.3)]
    whole = np.quantile(round_fits, 0.75) if len(round_fits) else density.max(initial=1.0)
    return density / max(float(whole), 1e-12)


def cover(points: SurfacePoints, tree: cKDTree, spheres: Spheres, merit: FloatArray) -> tuple[Spheres, IntArray]:
    """Accept spheres greedily by merit (C,) times the points that no better sphere has: (F spheres, (P,) owners)."""
    owners = np.full(len(points), -1, np.int64)
    near = neighborhoods(tree, spheres.centers, 1.35 * spheres.radii, 4 * NEIGHBORS)
    on, error, _, distance = on_sphere(points, near, spheres.centers, spheres.radii)
    inside = (near >= 0) & (distance < CORE * spheres.radii[:, None])
    value = on * np.clip(1.0 - np.abs(error) / (0.35 * spheres.radii[:, None]), 0.0, 1.0)
    own = value.sum(axis=1)
    heap = [(-own[index] * spheres.shell[index] * merit[index], index) for index in range(len(spheres))]
    heapq.heapify(heap)
    chosen: list[int] = []
    while heap:
        score, index = heapq.heappop(heap)
        free = (owners[near[index]] < 0) & (near[index] >= 0)
        left = (value[index] * free).sum()
        if left <= 0.0 or left < LEAST_FREE * own[index]:
            continue
        now = -(left * left / max(left + (inside[index] & free).sum(), 1e-9)) * merit[index]
        if now > 0.98 * score and heap and now > heap[0][0]:
            heapq.heappush(heap, (now, index))
            continue
        if chosen:
            apart = np.linalg.norm(spheres.centers[chosen] - spheres.centers[index], axis=1)
            if (apart < OVERLAP * (spheres.radii[chosen] + spheres.radii[index])).any():
                continue
        members = near[index][free & (on[index] | inside[index])]
        owners[members] = len(chosen)
        chosen.append(index)
    return spheres.select(np.array(chosen, np.int64)), owners


def connected(points: SurfacePoints, link: float) -> IntArray:
    """(P,) index of the connected cluster of each point; points nearer than about `link` are linked.

    Pairs among all points of a dense surface would fill any memory, so points share their cell of a grid of link / 5,
    and the cells' first points are linked.
    """
    cells = np.floor(points.positions / (link / 5.0)).astype(np.int64)
    _, first, cell_of = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    pairs = cKDTree(points.positions[first]).query_pairs(link, output_type="ndarray")
    size = (len(first), len(first))
    graph = coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=size)
    return connected_components(graph, directed=False)[1].astype(np.int64)[cell_of.reshape(-1)]


def refuse(spheres: Spheres, looks: Looks, components: IntArray, diameter: float) -> dict[int, str]:
    """By cluster, what is wrong with its best sphere; components: (C,) the cluster each sphere lies in."""
    best: dict[int, int] = {}
    for index in np.argsort(-spheres.support * spheres.shell, kind="stable"):
        best.setdefault(int(components[index]), int(index))
    told = _faults(spheres, looks)
    relative = 2.0 * spheres.radii / diameter
    return {
        component: f"the best sphere, of {relative[index]:.2f} mean diameters, is "
        + (", ".join(told[index]) or "on points of better fruit or of no fruit's size")
        for component, index in best.items()
    }


def _faults(spheres: Spheres, looks: Looks) -> list[list[str]]:
    """What each sphere fails by, with its number."""
    tests = [
        (spheres.thinness <= LEAST_THINNESS, spheres.thinness, "flat ({:.2f} radii thick)"),
        (sheets(spheres), spheres.residual, "a sheet ({:.2f} radii off the sphere)"),
        (spheres.coverage <= LEAST_COVERAGE, spheres.coverage, "covered on {:.0%} of its surface only"),
        (spheres.shell <= LEAST_SHELL, spheres.shell, "not hollow ({:.0%} of its points on the surface)"),
        (
            support_shares(spheres) <= LEAST_SUPPORT,
            support_shares(spheres),
            "thin of points ({:.0%} of a whole fruit's)",
        ),
        (looks.solidity <= LEAST_SOLIDITY, looks.solidity, "seen through ({:.0%} of its disc is opaque)"),
        (looks.probabilities <= LEAST_PROBABILITY, looks.probabilities, "not of the prompt ({:.2f} probable as seen)"),
    ]
    return [
        [text.format(values[index]) for fails, values, text in tests if fails[index]] for index in range(len(spheres))
    ]
