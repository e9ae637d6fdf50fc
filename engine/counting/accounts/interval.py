"""90 % intervals of the number of visible fruit and of all fruit, including hidden ones.

The log ratio of true fruit to the sum of the candidate probabilities is predicted from what the scene shows, with a
normal error that depends on the scene. Fitted by `scripts/developer/fit_interval.py`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..evidence.cluster import LIKELY, Search
from ..evidence.visibility import Picture
from ..regions.crown import estimate_hidden_share

FloatArray = NDArray[np.float64]

STORED = Path(__file__).with_name("interval.json")
ALONE, WITH_PHOTOS = "gaussians", "photos"
"""Names of the ratios for scenes whose fruit were searched on Gaussians only, and in photos too."""
COVARIATES = ("doubt", "faint", "hidden")
"""Names of the covariates that predict the ratio and its error; all 0 if every fruit is certain and fully visible."""
JOINED = 0.1
"""Least deviation of the log ratio if spheres were joined to long fruit: how many make one fruit is uncertain."""
TRAINED = 0.1
"""Typical faintness of trained scenes; that of true surfaces is 0."""
QUANTILE = 1.645
"""Standard deviations of a normal distribution on either side of 90 %."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a scene shows about its count. expected, variance: sum and variance of the number of fruit by the candidate
    probabilities; covariates: (3,) in the order of COVARIATES; photos, dissent: as of `Search`."""

    expected: float
    variance: float
    covariates: FloatArray
    photos: bool = False
    dissent: float = 0.0

    @property
    def faint(self) -> float:
        """How far the probabilities of the fruit's points are below certainty, 0…1."""
        return float(self.covariates[COVARIATES.index("faint")])


@dataclass(frozen=True, eq=False)
class Ratio:
    """log (fruit / expected) = bias + weights · covariates ± stretch · √(floor² + variance / expected² + Σ (slopes ·
    covariates)²); weights, slopes: (3,) in the order of COVARIATES; stretches: (2,) for scenes that are not faint and
    for trained ones, interpolated between them."""

    bias: float
    weights: FloatArray
    floor: float
    slopes: FloatArray
    stretches: FloatArray

    @classmethod
    def read(cls, document: dict[str, Any]) -> Ratio:
        """The ratio from the JSON of `document`."""
        arrays = {name: np.array(document[name], np.float64) for name in ("weights", "slopes", "stretches")}
        return cls(**{**document, **arrays})

    def document(self) -> dict[str, Any]:
        """The ratio as JSON."""
        names = ("bias", "weights", "floor", "slopes", "stretches")
        return {name: np.round(getattr(self, name), 5).tolist() for name in names}

    def mean(self, evidence: Evidence) -> float:
        """The predicted log ratio."""
        return self.bias + float(self.weights @ evidence.covariates)

    def deviation(self, evidence: Evidence) -> float:
        """Standard deviation of the log ratio, at least the dissent: if photos refuse what surfaces show, either may be
        wrong."""
        variance_share = evidence.variance / max(evidence.expected, 1.0) ** 2
        spread = ((self.slopes * evidence.covariates) ** 2).sum()
        stretch = float(np.interp(evidence.faint, [0.0, TRAINED], self.stretches))
        return max(stretch * float(np.sqrt(self.floor**2 + variance_share + spread)), evidence.dissent)

    def likeliest(self, evidence: Evidence) -> float:
        """The predicted number of fruit."""
        return evidence.expected * float(np.exp(self.mean(evidence)))

    def interval(self, evidence: Evidence, least_deviation: float = 0.0) -> tuple[int, int]:
        """Low and high number of fruit; least_deviation: lower bound of the deviation of the log ratio."""
        deviation = max(self.deviation(evidence), least_deviation)
        number, factor = self.likeliest(evidence), float(np.exp(QUANTILE * deviation))
        # Half a fruit either way: for a few fruit no interval is narrower.
        return max(int(np.ceil(number / factor - 0.5)), 0), int(np.floor(number * factor + 0.5))


@dataclass(frozen=True)
class Estimate:
    """visible: 90 % interval of the visible fruit, likely: their most likely number; total, total_interval: the most
    likely number and the 90 % interval of all fruit, hidden ones included."""

    visible: tuple[int, int]
    likely: float
    total: float
    total_interval: tuple[int, int]


def estimate(evidence: Evidence, count: int) -> Estimate:
    """The intervals of a count.

    That of visible fruit contains the count. That of all fruit starts and ends no lower; it may start above the count.
    `likely` and `total` lie in their intervals.
    """
    of_visible, of_all = load_ratios(evidence.photos)
    low, high = of_visible.interval(evidence)
    # The visible fruit are part of all fruit, so the interval of all fruit is not the narrower one.
    least, most = of_all.interval(evidence, of_visible.deviation(evidence))
    low, high = min(low, count), max(high, count)
    total = max(of_all.likeliest(evidence), float(count))
    bounds = min(max(least, low), int(total)), max(most, high, int(np.ceil(total)))
    likely = float(np.clip(of_visible.likeliest(evidence), low, high))
    return Estimate((low, high), round(likely, 1), round(total, 1), bounds)


def gather_evidence(
    found: Search, counts: FloatArray, pictures: Sequence[Picture], shares: FloatArray | None = None, *, seed: int
) -> Evidence:
    """Gather what the candidates and the views show about a count.

    counts: (C,) probability that each counts if it is a fruit; shares: (C,) how much of a fruit each is if fruit are
    long, whose parts are right or wrong together.
    """
    dissent = found.dissent if shares is None else max(found.dissent, JOINED)
    probabilities = counts * found.probabilities
    parts = probabilities if shares is None else shares * probabilities
    expected = float(parts.sum())
    if expected <= 0.0:
        return Evidence(0.0, 0.0, np.zeros(len(COVARIATES)), found.photos, dissent)
    variance = float((parts * (1.0 - probabilities)).sum())
    faint = 1.0 - float(parts @ found.features["mean"]) / expected
    centers = found.found.spheres.centers[probabilities > LIKELY]
    hidden = estimate_hidden_share(centers, pictures, found.size.diameter / 2.0, seed=seed)
    covariates = np.array([variance / expected, faint, -np.log(1.0 - hidden)])
    return Evidence(expected, variance, covariates, found.photos, dissent)


@cache
def load_ratios(photos: bool) -> tuple[Ratio, Ratio]:
    """Load the ratios for visible fruit and for all fruit that come with the package; photos: as in `Evidence`."""
    document = json.loads(STORED.read_text(encoding="utf-8"))[WITH_PHOTOS if photos else ALONE]
    return Ratio.read(document["visible"]), Ratio.read(document["total"])
