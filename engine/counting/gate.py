"""How likely a sphere is a fruit: a logistic regression on what speaks for it, fitted by `scripts/fit_gate.py`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .candidates import Candidates
from .claims import members
from .sample import SurfacePoints
from .size import FruitSize

FloatArray = NDArray[np.float64]
Features = Mapping[str, FloatArray]
"""(C,) numbers by name, one a candidate."""

STORED = Path(__file__).with_name("gate.json")
WEIGHED = ("coverage", "solidity", "thinness", "residual", "agreement", "share", "free", "off", "mean")
"""Features that the regression weighs."""
HALF = 0.5
"""Probabilities are weighed as if this were the threshold that the user set."""
SUREST = 0.25
"""What the surest tenth of a fruit's points exceed, as weighed; its other points may be fainter."""
WELL = 0.5
"""Spheres covered on more than this share tell how solid a fruit looks in a scene."""


@dataclass(frozen=True)
class Gate:
    """weights by feature, and bias, of the logistic regression."""

    weights: Mapping[str, float]
    bias: float

    def chances(self, features: Features) -> FloatArray:
        """(C,) probability of a fruit; 0 where not even the surest tenth of the points come near the threshold."""
        score = self.bias + sum(weight * features[name] for name, weight in self.weights.items())
        return np.where(features["surest"] > SUREST, 1.0 / (1.0 + np.exp(-score)), 0.0)

    def reason(self, features: Features, index: int) -> str:
        """What speaks most against a candidate, beside a fruit that is well seen, in words."""
        if features["surest"][index] <= SUREST:
            return f"its surest points come no nearer than {features['surest'][index] / HALF:.0%} to the threshold"
        against = {
            name: self.weights.get(name, 0.0) * (usual - float(features[name][index]))
            for name, (usual, _) in _TOLD.items()
        }
        worst = [name for name in sorted(against, key=lambda name: -against[name])[:2] if against[name] > 0.0]
        values = {name: float(features[name][index]) for name in worst}
        told = [_TOLD[name][1].format(np.exp(values[name]) if name in _LOGS else values[name]) for name in worst]
        return ", ".join(told) or "of an unlikely form"


_LOGS = frozenset({"coverage", "thinness", "share"})
"""Features that are logarithms."""
_TOLD = {
    "coverage": (np.log(0.6), "covered on {:.0%} of its surface only"),
    "solidity": (1.0, "seen through ({:.0%} as opaque as other fruit)"),
    "thinness": (np.log(0.3), "flat ({:.2f} radii thick)"),
    "residual": (0.06, "uneven ({:.2f} radii off a sphere)"),
    "agreement": (0.7, "not round (its points face outwards by {:.2f} of 1)"),
    "free": (1.0, "on points of better fruit ({:.0%} are its own)"),
    "mean": (0.9, "hardly of the prompt (its points are {:.2f} probable)"),
}
"""Each feature of a fruit that is well seen, and what is said of a candidate that lacks it."""


def features_of(found: Candidates, points: SurfacePoints, size: FruitSize, threshold: float) -> Features:
    """What speaks for and against the candidates.

    Solidity is relative to that of the scene's well covered spheres, because it depends on how opaque training made the
    Gaussians. points: in the order of `found.owners`; threshold: of the Gaussians' probability.
    """
    spheres, looks = found.spheres, found.looks
    well = looks.solidity[spheres.coverage > WELL]
    usual = float(np.median(well)) if len(well) else 1.0
    scaled = np.minimum(points.probabilities * (HALF / threshold), 1.0)
    owned = [scaled[own] for own in members(found.owners, len(found))]
    return {
        "coverage": np.log(np.maximum(spheres.coverage, 0.01)),
        "solidity": np.minimum(looks.solidity / max(usual, 0.1), 1.2),
        "thinness": np.log(np.maximum(spheres.thinness, 0.02)),
        "residual": spheres.residual,
        "agreement": spheres.agreement,
        "share": np.log(np.maximum(found.shares, 0.01)),
        "free": found.free,
        "off": (np.log(2.0 * spheres.radii / size.diameter) / size.spread) ** 2,
        "mean": np.array([each.mean() for each in owned]),
        "surest": np.array([np.quantile(each, 0.9) for each in owned]),
    }


@cache
def stored_gate() -> Gate:
    """The gate of the package."""
    document = json.loads(STORED.read_text(encoding="utf-8"))
    return Gate(document["weights"], document["bias"])
