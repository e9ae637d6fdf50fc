"""The fruit diameter estimated from the scene: the sphere radius that the surface points reproduce best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...progress import Progress, silent
from ..geometry.cells import Cells
from ..geometry.sphere import REACH, fit_spheres
from .surface_points import SurfacePoints

FloatArray = NDArray[np.float64]

SEEDS = 400
GRID_STEP = 1.18
NEIGHBORS = 96
CROWDED = 6 * NEIGHBORS
"""Median number of points of a fit above which larger radii are tried on every other point."""
BANDWIDTH = 0.08
LEAST_PEAK = 0.5
"""Of two radii that the points reproduce, the smaller one is used if it has at least this share of the evidence of the
larger one, and enough of its own: the outline of a whole crown is round as well."""
LEAST_EVIDENCE = 0.2
"""Below this summed weight per seed the selection is sheets and scatter, not fruit. Leaves, branches, grass and soil
reach .03 to .16, the most blurred plums .29, other fruit .9 and more."""
LEAST_AGREEMENT, AGREEMENT_RISE = 0.4, 0.3
"""Mean cosine between normals and those of a sphere from which it votes, and the range until it votes fully: a crown is
round as well, but its fruit face all sides."""
LEAST_THINNESS = 0.12
"""Flat neighbourhoods reproduce any radius; those thinner than this (in radii) do not vote."""


@dataclass(frozen=True)
class FruitSize:
    """diameter: of the mean fruit, scene units; spread: standard deviation of log diameter between fruit."""

    diameter: float
    spread: float


@dataclass(frozen=True)
class SizeEstimate(FruitSize):
    """evidence: summed weight of the fits at that diameter, per seed."""

    evidence: float


def estimate_diameter(points: SurfacePoints, smallest: float, *, progress: Progress = silent) -> SizeEstimate | None:
    """First high mode of the radii that spheres started at p − r·n along a log grid of r keep when refined freely.

    `smallest`: least radius tried, scene units (about the size of a Gaussian). A fit counts if it keeps its radius
    within 0.6 to 1.6 of the start, weighted by its coverage of directions and the share of its points on the shell.
    None if no part of the scene is round, which includes no points and points or Gaussians without extent.
    """
    largest = 0.5 * float(np.linalg.norm(np.ptp(points.positions, axis=0))) if len(points) else 0.0
    if largest == 0.0 or smallest == 0.0:
        return None
    seeds = np.argsort(points.turns, kind="stable")[:SEEDS]
    grid = smallest * GRID_STEP ** np.arange(max(1, int(np.log(max(largest / smallest, 1.0)) / np.log(GRID_STEP)) + 1))
    starting, inward = points.positions[seeds], points.normals[seeds]
    part = points
    logs, weights = [], []
    for step, radius in enumerate(grid[:40]):
        progress(step / min(len(grid), 40), f"Trying fruit of radius {radius:.3g}")
        starts = starting - radius * inward
        cells = Cells.of(part.positions, radius, part.turns)
        reaches, radii = np.full(len(seeds), REACH * radius), np.full(len(seeds), radius)
        spheres = fit_spheres(
            cells, part.normals[cells.index], starts, reaches, radii,
            prior=radius, prior_sd=0.6, rounds=8, limit=NEIGHBORS,
        )  # fmt: skip
        if np.median(cells.numbers(starts, reaches)) > CROWDED:
            part = part.thin(0.5)
        kept_radius = (spheres.radii > 0.6 * radius) & (spheres.radii < 1.6 * radius) & (spheres.support >= 8)
        round_enough = kept_radius & (spheres.thinness > LEAST_THINNESS)
        logs.append(np.log(spheres.radii))
        faced = np.clip((spheres.agreement - LEAST_AGREEMENT) / AGREEMENT_RISE, 0.0, 1.0)
        weights.append(np.where(round_enough, spheres.coverage * spheres.shell**2 * faced, 0.0))
    return _mode(np.concatenate(logs), np.concatenate(weights), len(seeds))


def _first_peak(density: FloatArray, enough: float) -> int:
    """The leftmost of the peaks that reach LEAST_PEAK of the highest and are `enough`: the fruit, not the crown."""
    padded, highest = np.pad(density, 1), density.max()
    peaks = (density >= padded[:-2]) & (density >= padded[2:])
    peaks &= density >= max(LEAST_PEAK * highest, min(enough, highest))
    return int(np.flatnonzero(peaks)[0])


def _mode(logs: FloatArray, weights: FloatArray, seeds: int) -> SizeEstimate | None:
    if weights.sum() <= 0.0:
        return None
    logs, weights = logs[weights > 0], weights[weights > 0]
    places = np.arange(logs.min() - 0.2, logs.max() + 0.2, 0.02)
    density = (weights * np.exp(-0.5 * ((places[:, None] - logs) / BANDWIDTH) ** 2)).sum(axis=1)
    peak = _first_peak(density, LEAST_EVIDENCE * seeds)
    mode = places[peak]
    for _ in range(20):
        local = weights * np.exp(-0.5 * ((logs - mode) / BANDWIDTH) ** 2)
        mode = float((local * logs).sum() / local.sum())
    close = np.abs(logs - mode) < 0.5
    spread = np.sqrt((weights[close] * (logs[close] - mode) ** 2).sum() / weights[close].sum())
    return SizeEstimate(float(2.0 * np.exp(mode)), float(spread), float(density[peak] / seeds))
