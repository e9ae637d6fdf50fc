"""The probability that a sphere is a fruit: a logistic regression on features and their products, fitted by
`scripts/developer/fit_gate.py`."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from .candidates import Candidates, SurfaceIndex
from .claims import members
from .size import FruitSize

FloatArray = NDArray[np.float64]
Features = Mapping[str, FloatArray]
"""(C,) numbers by name, one per candidate."""

STORED = Path(__file__).with_name("gate.json")
WEIGHED = (
    "coverage", "solidity", "thinness", "residual", "agreement", "share", "free", "off", "mean", "shown",
    "looked", "shell", "spread", "curvature",
)  # fmt: skip
"""Features of the regression. `looked` says how reliable solidity is, `spread` how reliable size is."""
HALF = 0.5
"""Probabilities are scaled as if the user had set this threshold."""
SUREST = 0.25
"""Scaled probability that the most probable tenth of a fruit's points exceeds; its other points may be fainter."""
FREE_SPOTS = 120.0
"""Number of free spots assumed for a candidate that no view shows: neither few nor many."""
WELL = 0.5
"""Spheres covered on more than this share show how solid and how curved a fruit looks in the scene."""
SPOT = 0.03
"""Radii: points closer together than this give no curvature."""
LEAST_USUAL = 0.1
"""Lower bounds of the typical solidity and curvature of a scene."""


@dataclass(frozen=True, eq=False)
class Gate:
    """score = bias + Σ linear_i x_i + Σ quadratic_ij x_i x_j of n features x, clipped to `low` and `high`, minus
    `center` and divided by `scale`.

    low, high, center, scale, linear: (n,) in the order of WEIGHED; quadratic: (n, n), 0 below the diagonal. Values
    beyond the range of the fit are clipped, because products extrapolate poorly.
    """

    low: FloatArray
    high: FloatArray
    center: FloatArray
    scale: FloatArray
    linear: FloatArray
    quadratic: FloatArray
    bias: float

    @classmethod
    def read(cls, path: Path) -> Gate:
        """The classifier from the JSON of `document`.

        Raises:
            FormatError: it was fitted to other features, or to the same in another order.
        """
        document = json.loads(path.read_text(encoding="utf-8"))
        if document["features"] != list(WEIGHED):
            raise FormatError(f"{path} was fitted to other features. Fit it again with scripts/developer/fit_gate.py")
        names = ("low", "high", "center", "scale", "linear", "quadratic")
        return cls(**{name: np.array(document[name], np.float64) for name in names}, bias=float(document["bias"]))

    def document(self) -> dict[str, Any]:
        """The classifier as JSON."""
        names = ("low", "high", "center", "scale", "linear", "quadratic")
        parts = {name: getattr(self, name).round(5).tolist() for name in names}
        return {"features": list(WEIGHED), **parts, "bias": round(self.bias, 5)}

    def score(self, values: FloatArray) -> FloatArray:
        """(C,) log odds of a fruit, from features (C, n) in the order of WEIGHED."""
        x = (np.clip(values, self.low, self.high) - self.center) / self.scale
        scores: FloatArray = self.bias + x @ self.linear + ((x @ self.quadratic) * x).sum(axis=1)
        return scores

    def probabilities(self, features: Features) -> FloatArray:
        """(C,) probability of a fruit; 0 if not even the most probable tenth of the points comes near the threshold."""
        return np.where(features["surest"] > SUREST, 1.0 / (1.0 + np.exp(-self.score(stack_features(features)))), 0.0)

    def reason(self, features: Features, index: int) -> str:
        """What counts most against a candidate compared with a fully visible fruit, in words."""
        if features["surest"][index] <= SUREST:
            return (
                f"its most probable points come no nearer than {features['surest'][index] / HALF:.0%} to the threshold"
            )
        own = stack_features(features)[index]
        instead = np.repeat(own[None], len(_TEXTS), axis=0)
        for row, (name, (usual, _)) in enumerate(_TEXTS.items()):
            instead[row, WEIGHED.index(name)] = usual
        lost = self.score(instead) - self.score(own[None])
        worst = [
            name for name, loss in sorted(zip(_TEXTS, lost, strict=True), key=lambda pair: -pair[1])[:2] if loss > 0
        ]
        values = {name: float(own[WEIGHED.index(name)]) for name in worst}
        reasons = [_TEXTS[name][1].format(np.exp(values[name]) if name in _LOGS else values[name]) for name in worst]
        return ", ".join(reasons) or "of an unlikely form"


def stack_features(features: Features) -> FloatArray:
    """Stack the features, (C, n), in the order of WEIGHED."""
    return np.stack([features[name] for name in WEIGHED], axis=1)


_LOGS = frozenset({"coverage", "thinness", "share"})
"""Features that are logarithms."""
_TEXTS = {
    "coverage": (np.log(0.6), "covered on {:.0%} of its surface only"),
    "solidity": (1.0, "seen through ({:.0%} as opaque as other fruit)"),
    "thinness": (np.log(0.3), "flat ({:.2f} radii thick)"),
    "residual": (0.06, "uneven ({:.2f} radii off a sphere)"),
    "agreement": (0.7, "not round (its points face outwards by {:.2f} of 1)"),
    "curvature": (1.0, "hardly curved (its points' normals turn {:.0%} as fast as on other fruit)"),
    "free": (1.0, "on points of better fruit ({:.0%} are its own)"),
    "mean": (0.9, "hardly of the prompt (its points are {:.2f} probable)"),
}
"""Each feature of a fully visible fruit, and the text for a candidate that lacks it."""


def features_of(found: Candidates, surface: SurfaceIndex, size: FruitSize, threshold: float) -> Features:
    """The features of the candidates.

    Solidity and curvature are relative to those of the well covered spheres of the scene, because they depend on how
    opaque and even training made the Gaussians. surface: the points that `found.owners` refers to; threshold: of the
    Gaussians' probability.
    """
    spheres, view_evidence = found.spheres, found.view_evidence
    well = spheres.coverage > WELL
    scaled = np.minimum(surface.points.probabilities * (HALF / threshold), 1.0)
    owned = [scaled[own] for own in members(found.owners, len(found))]
    return {
        "coverage": np.log(np.maximum(spheres.coverage, 0.01)),
        "solidity": np.minimum(_relative(view_evidence.solidity, well), 1.2),
        "thinness": np.log(np.maximum(spheres.thinness, 0.02)),
        "residual": spheres.residual,
        "agreement": spheres.agreement,
        "share": np.log(np.maximum(found.shares, 0.01)),
        "free": found.free,
        "off": (np.log(2.0 * spheres.radii / size.diameter) / size.spread) ** 2,
        "shown": np.log(np.maximum(np.nan_to_num(view_evidence.visible_fractions, nan=1.0), 0.02)),
        "looked": np.log1p(np.where(view_evidence.free > 0, view_evidence.free, FREE_SPOTS)),
        "shell": spheres.shell,
        "spread": np.full(len(found), size.spread),
        "curvature": _relative(curvatures(found, surface), well),
        "mean": np.array([each.mean() if len(each) else 0.0 for each in owned]),
        "surest": np.array([np.quantile(each, 0.9) if len(each) else 0.0 for each in owned]),
    }


def curvatures(found: Candidates, surface: SurfaceIndex) -> FloatArray:
    """(C,) how fast the normals n turn along each candidate's own points x, in its radii: 1 on a sphere, 0 on a leaf.

    The slope Σ (x - x̄)·(n - n̄) / Σ |x - x̄|² distinguishes a piece of a sphere from a flat surface, however small it
    is.
    """
    owned = found.owners >= 0
    owner, count = found.owners[owned], len(found)
    number = np.bincount(owner, minlength=count)

    def mean(values: FloatArray) -> FloatArray:
        sums = [np.bincount(owner, weights=column, minlength=count) for column in values.T]
        means: FloatArray = np.stack(sums, axis=1) / np.maximum(number, 1)[:, None]
        return means

    x = (surface.points.positions[owned] - found.spheres.centers[owner]) / found.spheres.radii[owner, None]
    n = surface.normals[owned]
    turned = mean(x * n).sum(axis=1) - (mean(x) * mean(n)).sum(axis=1)
    spread = mean(x**2).sum(axis=1) - (mean(x) ** 2).sum(axis=1)
    slopes: FloatArray = np.where(spread > SPOT**2, turned / np.maximum(spread, SPOT**2), 1.0)
    return slopes


def _relative(values: FloatArray, well: NDArray[np.bool_]) -> FloatArray:
    """(C,) values relative to the typical value of the `well` covered spheres (C,); unchanged if there are none."""
    usual = float(np.median(values[well])) if well.any() else 1.0
    return values / max(usual, LEAST_USUAL)


@cache
def load_gate() -> Gate:
    """Load the classifier that comes with the package."""
    return Gate.read(STORED)
