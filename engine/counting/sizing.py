"""The Gaussians that may be fruit, the size of these fruit, and the points in which they are searched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..config import CountConfig
from ..errors import CountingError
from ..progress import Progress, silent
from ..splatting.gaussians import Gaussians
from .evidence.size import LEAST_EVIDENCE, FruitSize, estimate_diameter
from .evidence.surface_points import LARGEST_SCALE, SURFACE, SurfacePoints, sample_enough, sample_surface, sample_volume
from .evidence.visibility import Visibility

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

LEAST_OPACITY = 0.05
FAINT = 1.0 / 3.0
"""Share of the threshold above which a Gaussian may belong to a fruit whose other Gaussians are above the threshold."""
SIZING_POINTS, SIZING_SHARE = 20_000, 0.5
"""Points for the size estimate, or this many per Gaussian if that is more: ten per fruit are too few."""
VOLUME_POINTS = 60_000
"""Number of points of the paper's sampling."""
DEFAULT_SPREAD = 0.2
"""Standard deviation of log diameter between fruit if the diameter is given."""
FACELESS = "has a side that faces the cameras and is not inside another"
"""Text for Gaussians that give no surface points: seen equally from opposite sides, they have no outer side."""
UNLIKE = 1.6
"""Ratio of the given diameter to that of the scene above which the user is notified."""
FIRST_SPREADS = (0.15, 0.35)
"""Least and largest standard deviation of log diameter to start from."""


def select_gaussians(gaussians: Gaussians, probabilities: FloatArray, config: CountConfig) -> IntArray:
    """Which Gaussians may give surface points: opaque, and with a high enough probability (N,)."""
    opaque = gaussians.opacities.detach().double().cpu().numpy() >= LEAST_OPACITY
    least = config.threshold * (FAINT if config.method == "voting" else 1.0)
    return np.flatnonzero((probabilities >= least) & opaque)


def fruit_size(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    progress: Progress = silent,
) -> FruitSize | None:
    """The size of the fruit, given or estimated; None if no part of the scene is round or gives points.

    probabilities: (N,) of the Gaussians; seen: those that may be fruit and that a view shows.
    """
    if config.diameter is not None:
        return FruitSize(config.diameter, DEFAULT_SPREAD)
    points = _sizing_points(gaussians, probabilities, visibility, seen, config)
    typical = float(np.median(_widths(gaussians, seen)))
    estimate = estimate_diameter(points, typical, progress=progress)
    if estimate is None or estimate.evidence < LEAST_EVIDENCE:
        return None
    return FruitSize(estimate.diameter, float(np.clip(estimate.spread, *FIRST_SPREADS)))


def check_diameter(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    progress: Progress = silent,
) -> list[str]:
    """Check a given diameter and return notices: one in another unit would find other objects, or nothing.

    Raises:
        CountingError: a fruit of that size is larger than all that may be fruit.
    """
    if config.diameter is None:
        return []
    places = gaussians.means.detach().double().cpu().numpy()[seen]
    extent = float(np.linalg.norm(np.ptp(places, axis=0)) + 2.0 * SURFACE * _widths(gaussians, seen).max())
    if config.diameter > extent:
        raise CountingError(
            f"--count.diameter {config.diameter:.4g} is larger than all that may be fruit, which extends over "
            f"{extent:.4g} scene units. Give the diameter in scene units, or leave it out"
        )
    without = replace(config, diameter=None)
    measured = fruit_size(gaussians, probabilities, visibility, seen, without, progress)
    if measured is None or abs(np.log(config.diameter / measured.diameter)) < np.log(UNLIKE):
        return []
    return [
        f"fruit of diameter {config.diameter:.4g} scene units were counted, as --count.diameter says, but those of "
        f"the scene are {measured.diameter:.4g} wide. Without the setting these are counted"
    ]


def _sizing_points(
    gaussians: Gaussians, probabilities: FloatArray, visibility: Visibility, seen: IntArray, config: CountConfig
) -> SurfacePoints:
    """The points for the size estimate."""
    return sample_surface(
        gaussians,
        probabilities,
        visibility,
        seen,
        budget=min(max(SIZING_POINTS, int(SIZING_SHARE * len(seen))), config.sample_budget),
        seed=config.seed,
        largest=8.0 * float(np.median(_widths(gaussians, seen))),
    )


def _widths(gaussians: Gaussians, index: IntArray) -> FloatArray:
    """(G,) largest standard deviation of each of the Gaussians at `index` (G,), scene units."""
    widths: FloatArray = gaussians.scales.detach().double().cpu().numpy()[index].max(axis=1)
    return widths


def explain_no_size(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    config: CountConfig,
    label: str,
) -> str:
    """Say why no size can be estimated from the visible Gaussians."""
    if len(_sizing_points(gaussians, probabilities, visibility, seen, config)) == 0:
        return f"none of the {len(seen)} Gaussians of {label} {FACELESS}"
    return f"none of the {len(seen)} Gaussians of {label} lie on anything round"


def require_fine(
    gaussians: Gaussians, seen: IntArray, diameter: float, config: CountConfig, reason: str, label: str
) -> None:
    """Refuse a 0 that comes from Gaussians larger than the fruit, or from a diameter smaller than the Gaussians.

    Raises:
        CountingError: most of the visible Gaussians are larger than the expected fruit.
    """
    if np.mean(_widths(gaussians, seen) > LARGEST_SCALE * diameter) <= 0.5:
        return
    advice = (
        "The reconstruction is too blurred: take sharper photos, read them larger (--scene.max-side), or train more "
        "Gaussians for more steps (--train.max-gaussians, --train.steps)"
        if config.diameter is None
        else f"--count.diameter {diameter:.4g} is too small: give it in scene units, or leave it out"
    )
    raise CountingError(f"The 0 for {label} is not a count: {reason}. {advice}")


def explain_no_points(gaussians: Gaussians, seen: IntArray, diameter: float, label: str) -> str:
    """Say why the visible Gaussians give no points."""
    large = int((_widths(gaussians, seen) > LARGEST_SCALE * diameter).sum())
    if large == len(seen):
        return f"all {large} Gaussians of {label} are larger than the expected fruit"
    text = f"none of the {len(seen) - large} Gaussians of {label} {FACELESS}"
    return text + (f"; {large} others are larger than the expected fruit" if large else "")


def sample_points(
    gaussians: Gaussians,
    probabilities: FloatArray,
    visibility: Visibility,
    seen: IntArray,
    diameter: float,
    config: CountConfig,
) -> SurfacePoints:
    """Sample the points to count in: on surfaces, or spread through the volume for the published methods."""
    if config.method == "voting":
        return sample_enough(
            gaussians, probabilities, visibility, seen, diameter=diameter, most=config.sample_budget, seed=config.seed
        )
    return sample_volume(
        gaussians, probabilities, visibility, seen,
        budget=min(VOLUME_POINTS, config.sample_budget), seed=config.seed, largest=LARGEST_SCALE * diameter,
    )  # fmt: skip
