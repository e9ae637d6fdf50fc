"""The crown around fruit, and how much of it no photo shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks
from scipy.spatial import ConvexHull, QhullError

from ..evidence.visibility import Picture, count_open_views

FloatArray = NDArray[np.float64]

PLACES = 2000
"""Places inside the crowns that are tested for visibility."""
SHORTEST_ROW = 3.0
"""Widths of the region with fruit above which it is a row: no single crown is as long."""
OUTERMOST = (0.05, 0.95)
"""Quantiles of the fruit between which length and width of their region are measured."""
SMOOTHING = 0.15
"""Standard deviation, in widths of the row, with which the density of fruit along it is smoothed."""
LEAST_VALLEY, CROWN_DENSITY = 0.5, 0.9
"""Least depth of a valley between two trees, and the quantile of the density along the row that it is relative to."""
LONGEST_CROWN, LONGEST_PART = 1.4, 2.0
"""Widths of the row up to which parts are joined to one crown, and above which a part without gaps is cut."""
OUTSIDE, FALLING = 2.2, 0.39
"""The hull of n fruit that are spread evenly in a ball leaves out about OUTSIDE / n^FALLING of the ball (measured on
random samples: .86 for 10 fruit, .52 for 50, .19 for 500). That part is visible."""


def hull_share(count: int) -> float:
    """Share of the volume of a crown that the hull of this many fruit contains."""
    return float(max(1.0 - OUTSIDE / max(count, 1) ** FALLING, 0.0))


def estimate_hidden_share(centers: FloatArray, pictures: Sequence[Picture], radius: float, *, seed: int) -> float:
    """Estimate the share of the crowns around fruit (F, 3) in which no view would show a fruit of this radius, scene
    units.

    The mean over crowns by their number of fruit. A long row is cut into sections, because the hull of a whole row
    would contain the gaps between its trees.
    """
    crowns = split_row(centers)
    places = sample_crowns(crowns, seed)
    everywhere = np.concatenate(places)
    hidden = count_open_views(pictures, everywhere, np.full(len(everywhere), radius)) == 0
    parts = np.split(hidden, np.cumsum([len(own) for own in places])[:-1])
    fruit = sum(
        len(crown) * hull_share(len(crown)) * float(own.mean())
        for crown, own in zip(crowns, parts, strict=True)
        if len(own)
    )
    return fruit / max(len(centers), 1)


def sample_crowns(crowns: Sequence[FloatArray], seed: int) -> list[FloatArray]:
    """Sample places (K, 3) in each crown of fruit (F, 3): together about PLACES, shared out by the fruit."""
    rng, total = np.random.default_rng(seed), max(sum(len(crown) for crown in crowns), 1)
    return [sample_hull(crown, -(-PLACES * len(crown) // total), rng) for crown in crowns]


def split_row(centers: FloatArray) -> list[FloatArray]:
    """The fruit (F, 3) of a long row in sections: its trees where gaps separate them, else parts about as long as the
    row is wide or high. One section if it is no long row."""
    if len(centers) < 2:
        return [centers]
    offsets = centers - centers.mean(axis=0)
    places, across = (offsets @ np.linalg.svd(offsets, full_matrices=False)[2][:2].T).T
    places = places if (places**3).sum() >= 0.0 else -places  # one direction, however the scene is turned
    length, width = (float(np.ptp(np.quantile(each, OUTERMOST))) for each in (places, across))
    if length <= SHORTEST_ROW * width:
        return [centers]
    gaps = _find_gaps(places, max(width, length / len(centers)))
    parts = _join_parts(np.sort(places), gaps, LONGEST_CROWN * width)
    lengths = np.ptp(parts, axis=1)
    pieces = np.where(lengths > LONGEST_PART * width, np.round(lengths / max(width, 1e-12)), 1.0)
    own = np.searchsorted(parts[:, 0], places, side="right") - 1
    along = (places - parts[own, 0]) / np.maximum(lengths[own], 1e-12)
    numbers = np.cumsum(pieces)[own] - pieces[own] + np.minimum(np.floor(along * pieces[own]), pieces[own] - 1.0)
    return [centers[numbers == number] for number in np.unique(numbers)]


def _find_gaps(places: FloatArray, width: float) -> FloatArray:
    """Find where along the row the density of fruit at `places` (F,) has valleys, ascending; width: of the row."""
    step = SMOOTHING * width / 4.0
    density = np.bincount(((places - places.min()) / step).astype(np.int64), minlength=1).astype(np.float64)
    smooth = gaussian_filter1d(density, 4.0, mode="constant")
    valleys = find_peaks(-smooth, prominence=LEAST_VALLEY * np.quantile(smooth, CROWN_DENSITY))[0]
    return places.min() + (valleys + 0.5) * step


def _join_parts(ordered: FloatArray, gaps: FloatArray, crown: float) -> FloatArray:
    """Return the first and last fruit (K, 2) of the parts between `gaps`; parts that are together no longer than a
    `crown` are one. ordered: (F,) places of the fruit along the row, ascending."""
    parts = list[tuple[float, float]]()
    for own in np.split(ordered, np.searchsorted(ordered, gaps)):
        if len(own) == 0:
            continue
        low, high = float(own[0]), float(own[-1])
        if parts and high - parts[-1][0] <= crown:
            low = parts.pop()[0]
        parts.append((low, high))
    return np.array(parts)


def sample_hull(centers: FloatArray, number: int, rng: np.random.Generator) -> FloatArray:
    """(number, 3) places spread evenly over the hull of centers (F, 3); none if they have no hull.

    The hull is cut into tetrahedra between its middle and its sides. These are taken by the distances of their corners,
    so places move with the centers.
    """
    try:
        hull = ConvexHull(centers)
    except (QhullError, ValueError):
        return np.zeros((0, 3))
    middle = centers[hull.vertices].mean(axis=0)
    corners = centers[hull.simplices] - middle
    distances = np.linalg.norm(corners, axis=2)
    corners = np.take_along_axis(corners, np.argsort(distances, axis=1)[:, :, None], axis=1)
    corners = corners[np.argsort(distances.sum(axis=1), kind="stable")]
    volumes = np.abs(np.linalg.det(corners))
    drawn = (np.arange(number) + rng.random(number)) / max(number, 1)
    chosen = np.minimum(np.searchsorted(np.cumsum(volumes) / volumes.sum(), drawn), len(volumes) - 1)
    weights = rng.standard_exponential((number, 4))  # normalized, these are even over a tetrahedron
    weights /= weights.sum(axis=1, keepdims=True)
    places: FloatArray = middle + np.einsum("pk,pki->pi", weights[:, 1:], corners[chosen])
    return places
