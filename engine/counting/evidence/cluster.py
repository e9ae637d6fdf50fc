"""Fruit among surface points: candidates with probabilities, and what every cluster of points became."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ...progress import Progress, silent
from ..geometry.cells import Cells, link_points
from ..geometry.ellipsoid import fit_ellipsoids
from ..geometry.sphere import REACH, Spheres, fit_spheres
from .candidates import Candidates, SurfaceIndex, find_candidates
from .claims import commonest, members
from .gate import Features, features_of, load_gate
from .long_fruit import Parts, find_bodies, join_bodies
from .size import FruitSize
from .surface_points import SurfacePoints
from .visibility import Picture, distance_of

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LINK = 0.15
"""Points nearer to each other than this, in mean diameters, belong to one cluster."""
LINKS = 5.0
"""Of points nearer than this share of a link, only one searches for neighbours."""
LIKELY = 0.5
"""Least probability of a fruit that is counted."""
SPREADS = (0.08, 0.5)
"""Least and largest standard deviation of log diameter that is accepted."""
SETTLED = 0.03
"""Refinement stops when the logarithms of diameter and spread change by less."""
DIAMETER_STEP, SPREAD_STEP = 0.02, 0.02
"""Estimates of log diameter and of its deviation are rounded to this."""
FEWEST = 3
"""Number of fruit needed to refine a size."""
USUAL, USUALLY = 0.15, 5.0
"""Prior deviation of log diameter, and the number of fruit that it counts for: a few fruit do not determine a
spread."""
ROUNDS, COARSE = 3, 3
"""Rounds of refinement, and the share of the points used for it."""
LOOSE, FAR = 0.6, 0.5
"""Deviation of log radius that loose fits are held to, and radii that they may move: fruit held to the mean are as
alike as they are held to be."""
COVERED, ENOUGH = 0.3, 10
"""Coverage of a loose fit that is used for the spread, and how many of them are needed."""
NOISE, CUT = 0.07, 0.88
"""Deviation of their log radii from noise alone, and that of a normal distribution truncated at two deviations."""
UNTOLD = 0.4
"""Share of the spread of sizes that is added to the fit's own deviation: deviation from a sphere, and hidden parts."""
STEADY = 0.25
"""Radii by which a fruit may move when it is fitted again from its own position, so that the start does not matter."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """What the surface points became.

    points: the P surface points, in their own order; spheres: the F accepted fruit; owners: (P,) index of the sphere
    each point belongs to, -1 for none; components: (P,) index of the connected cluster of a point; probabilities: (F,)
    that a sphere is a fruit of the prompt; refusals: by cluster, why the most probable candidate of a cluster without
    fruit was refused; findings: by cluster, why a cluster with fruit was kept, if not by its spheres; small: spheres of
    kind small, whatever their size; axes: (F, 3, 3), rows are half axes in radii as in `ellipsoid.Ellipsoids`, None if
    fruit are spheres; parts: the spheres along long fruit, None if fruit are not long.
    """

    points: SurfacePoints
    spheres: Spheres
    owners: IntArray
    components: IntArray
    probabilities: FloatArray
    refusals: Mapping[int, str]
    findings: Mapping[int, str] = field(default_factory=dict)
    small: Collection[int] = ()
    axes: FloatArray | None = None
    parts: Parts | None = None

    def keep(self, kept: NDArray[np.bool_], shown: NDArray[np.bool_], reason: str) -> Clusters:
        """Keep only the fruit that are `kept` (F,), and the points that are `shown` (P,); reason: for leaving out the
        others."""
        numbers = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
        lost = np.append(~kept, False)[self.owners]
        reasons = dict.fromkeys(np.unique(self.components[lost]).tolist(), reason) | dict(self.refusals)
        names, components = np.unique(self.components[shown], return_inverse=True)
        return replace(
            self,
            points=self.points.select(shown),
            spheres=self.spheres.select(kept),
            owners=numbers[self.owners[shown]],
            components=components.astype(np.int64),
            probabilities=self.probabilities[kept],
            refusals={new: reasons[old] for new, old in enumerate(names.tolist()) if old in reasons},
            findings={new: self.findings[old] for new, old in enumerate(names.tolist()) if old in self.findings},
            small=frozenset(int(numbers[index]) for index in self.small if kept[index]),
            axes=None if self.axes is None else self.axes[kept],
            parts=None if self.parts is None else self.parts.keep(numbers[:-1]),
        )

    def refusal(self, component: int) -> str:
        """Why a cluster has no fruit."""
        return self.refusals.get(component, "its points face no common centre")


@dataclass(frozen=True, eq=False)
class Search:
    """Candidates among surface points, with features (C,) by name and the probability (C,) that each is a fruit;
    photos: whether fruit were searched in photos too; dissent: logarithm of how many times more fruit were expected
    without them, less what is usual, 0 if not more; on_surfaces: (K, 3) centers of the likely fruit without them."""

    surface: SurfaceIndex
    size: FruitSize
    found: Candidates
    features: Features
    probabilities: FloatArray
    photos: bool = False
    dissent: float = 0.0
    on_surfaces: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


def search(
    points: SurfacePoints,
    size: FruitSize,
    pictures: Sequence[Picture],
    threshold: float,
    *,
    given: bool = False,
    progress: Progress = silent,
) -> Search:
    """Search for spheres that explain the points, and estimate their probabilities.

    size: estimated, or `given` by the user: an estimate is refined by the fruit that are found with it; threshold: of
    the Gaussians' probability.
    """
    progress(0.0, "finding normals")
    if not given:
        unit = distance_of([picture.camera for picture in pictures])
        size = round_size(size, unit)
        surface = SurfaceIndex.of(points.thin(1.0 / COARSE), size.diameter)
        for step in range(ROUNDS):
            progress(0.1 + 0.1 * step, f"Searching fruit of diameter {size.diameter:.3g}")
            coarse = _search_surface(surface, size, pictures, threshold)
            loose = _refit(coarse, coarse.found.spheres, LOOSE, FAR)
            before, size = size, round_size(refine(size, coarse.found.spheres, coarse.probabilities, loose), unit)
            change = np.log([size.diameter / before.diameter, size.spread / before.spread])
            if (np.abs(change) < SETTLED).all():
                break
    progress(0.5, f"Searching all fruit of diameter {size.diameter:.3g}")
    return _search_surface(SurfaceIndex.of(points, size.diameter), size, pictures, threshold)


def _search_surface(surface: SurfaceIndex, size: FruitSize, pictures: Sequence[Picture], threshold: float) -> Search:
    found = find_candidates(surface, size, pictures, threshold)
    features = features_of(found, surface, size, threshold)
    return Search(surface, size, found, features, load_gate().probabilities(features))


def find_fruit(result: Search, *, lengthwise: bool = True) -> Clusters:
    """The likely fruit among the candidates, and what every cluster of points became. lengthwise: whether spheres may
    be parts of long fruit.

    Centres and radii that photos tell are kept: those of Gaussians, which are blurred, are worse.
    """
    found, probabilities = result.found, result.probabilities
    components = find_components(result.surface.points, LINK * result.size.diameter)
    kept = probabilities > LIKELY
    owners = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)[found.owners]
    likely = found.spheres.select(kept)
    settled = likely if result.photos else _refit(result, likely, result.size.spread, STEADY)
    fitted = fit_ellipsoids(result.surface.cells, result.surface.normals, owners, settled)
    found_fruit = Clusters(
        result.surface.points,
        settled if result.photos else _add_untold_spread(fitted.spheres, result.size.spread),
        owners,
        components,
        probabilities[kept],
        _refusals(result, kept, components),
        axes=fitted.axes,
    )
    numbers = find_bodies(result.surface.points.positions, settled) if lengthwise else None
    return found_fruit if numbers is None else _join_lengthwise(found_fruit, settled, numbers)


def _add_untold_spread(spheres: Spheres, spread: float) -> Spheres:
    """Add to spheres fitted to points the deviation of their radii that fits do not tell."""
    return replace(spheres, radius_sds=np.hypot(spheres.radius_sds, UNTOLD * spread * spheres.radii))


def _join_lengthwise(clusters: Clusters, spheres: Spheres, numbers: IntArray) -> Clusters:
    """Replace the spheres along long fruit by these. numbers: (F,) the body of each sphere."""
    together, axes, parts = join_bodies(spheres, numbers)
    chances = 1.0 - clusters.probabilities
    unlikely = np.ones(len(together))
    np.multiply.at(unlikely, numbers, chances)
    owners = np.append(numbers, -1)[clusters.owners]
    return replace(clusters, spheres=together, owners=owners, probabilities=1.0 - unlikely, axes=axes, parts=parts)


def _refit(result: Search, spheres: Spheres, spread: float, farthest: float) -> Spheres:
    """Fit each of the spheres again from its own position, held to the size by a deviation `spread` of log radius; one
    that moves by `farthest` of its radius or more stays unchanged."""
    fitted = fit_spheres(
        result.surface.cells, result.surface.normals, spheres.centers, REACH * spheres.radii, spheres.radii,
        prior=result.size.diameter / 2.0, prior_sd=spread,
    )  # fmt: skip
    moved = np.linalg.norm(fitted.centers - spheres.centers, axis=1) + np.abs(fitted.radii - spheres.radii)
    return fitted.where(moved < farthest * spheres.radii, spheres)


def refine(size: FruitSize, spheres: Spheres, probabilities: FloatArray, loose: Spheres) -> FruitSize:
    """The mean and spread of log diameter of the likely fruit (C,): one step of expectation maximisation.

    The uncertainty of each sphere adds to the spread, because poorly determined spheres were held at the mean. If the
    well covered ones among the `loose` fits differ by more than noise, that difference is the spread, corrected for the
    truncation by the choice of likely fruit. The spread is held near its prior: if a few fruit are alike by chance,
    another one must not be refused for its size.
    """
    weights = np.where(probabilities > LIKELY, probabilities, 0.0)
    if np.count_nonzero(weights) < FEWEST:
        return size
    mean, variance = _moments(spheres, weights)
    variance += float((weights * (spheres.radius_sds / spheres.radii) ** 2).sum() / weights.sum())
    covered = np.where(loose.coverage > COVERED, weights, 0.0)
    if np.count_nonzero(covered) >= ENOUGH:
        variance = max(variance, (_moments(loose, covered)[1] - NOISE**2) / CUT**2)
    known = float(weights.sum())
    variance = (known * variance + USUALLY * USUAL**2) / (known + USUALLY)
    return FruitSize(float(np.exp(mean)), float(np.clip(np.sqrt(variance), *SPREADS)))


def round_size(size: FruitSize, unit: float) -> FruitSize:
    """Round the size to steps of log diameter and spread, so that sizes that differ by less than the error of an
    estimate give the same fruit. unit: a length that scales with the scene."""
    diameter = unit * np.exp(DIAMETER_STEP * np.round(np.log(size.diameter / unit) / DIAMETER_STEP))
    return FruitSize(float(diameter), float(SPREAD_STEP * np.round(size.spread / SPREAD_STEP)))


def _moments(spheres: Spheres, weights: FloatArray) -> tuple[float, float]:
    """Weighted mean and variance of log diameter."""
    logs = np.log(2.0 * spheres.radii)
    mean = float((weights * logs).sum() / weights.sum())
    return mean, float((weights * (logs - mean) ** 2).sum() / weights.sum())


def find_components(points: SurfacePoints, link: float) -> IntArray:
    """Find the index (P,) of the connected cluster of each point; points nearer than `link` are linked.

    In a dense surface, points LINKS times as close represent each other.
    """
    cells = Cells.of(points.positions, link)
    numbers = np.empty(len(points), np.int64)
    numbers[cells.index] = np.unique(link_points(cells.table, link, link / LINKS), return_inverse=True)[1]
    return numbers


def _refusals(result: Search, kept: NDArray[np.bool_], components: IntArray) -> dict[int, str]:
    """By cluster, why the most probable of its rejected candidates was refused."""
    gate, reasons, own = load_gate(), dict[int, str](), members(result.found.owners, len(kept))
    for index in np.argsort(-result.probabilities, kind="stable"):
        if not kept[index] and len(own[index]):
            home = commonest(components[own[index]])
            reason = gate.reason(result.features, int(index))
            reasons.setdefault(home, f"the best sphere is {result.probabilities[index]:.0%} likely a fruit: {reason}")
    return reasons
