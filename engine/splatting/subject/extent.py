"""The length of an object that Gaussians represent."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from ..gaussians import Gaussians

LEAST_GAUSSIANS = 10
"""Fewer Gaussians are no object."""
GAP = 0.25
"""Parts nearer to an object than this share of its length belong to it: leaves hide what lies between."""
LEAST_PART = 0.02
"""Share of the pixels of the largest part that another part of an object must have."""
_NEIGHBOUR, _REACH = 4, 3.0
"""Gaussians are connected within this many times the median distance to this neighbour."""

FloatArray = NDArray[np.float64]


def longest_side(gaussians: Gaussians, drawn: NDArray[np.float32]) -> float | None:
    """The longest side of the smallest box around the largest object that the Gaussians represent, in scene units.

    The largest object is the connected part that covers most pixels of the photos, and parts near it. A Gaussian
    extends as far as it stops half of the light: o·exp(-d²/2) = ½ at d = √(2 ln 2o) standard deviations; those of
    opacity o below ½ do not count. None if no part has ten Gaussians.

    drawn: (N,) pixels that each covers.
    """
    solid = gaussians.opacities > 0.5
    gaussians, drawn = gaussians.select(solid), drawn[solid.numpy()]
    if len(gaussians) < LEAST_GAUSSIANS:
        return None
    means, tips = gaussians.means.double().numpy(), _tips(gaussians)
    part = _parts(means)
    sizes, pixels = np.bincount(part), np.bincount(part, drawn)
    largest = pixels.argmax()
    if sizes[largest] < LEAST_GAUSSIANS:
        return None
    thing = part == largest
    real = (pixels >= LEAST_PART * pixels[largest])[part]
    while True:
        side = _box_side(tips[thing])
        distances, _ = cKDTree(means[thing]).query(means)
        near = real & ~thing & (distances < GAP * side)
        if not near.any():
            return side
        thing |= np.isin(part, part[near])


def _tips(gaussians: Gaussians) -> FloatArray:
    """(N, 6, 3) the ends of the axes of each Gaussian."""
    reach = (2.0 * (2.0 * gaussians.opacities).log()).sqrt()
    steps = (gaussians.rotations * (gaussians.scales * reach[:, None])[:, None, :]).transpose(1, 2)
    return (gaussians.means[:, None] + torch.cat([steps, -steps], dim=1)).double().numpy()


def _box_side(tips: FloatArray) -> float:
    """The longest side of the smallest box around tips (…, 3)."""
    points = tips.reshape(-1, 3) - tips.reshape(-1, 3).mean(0)
    size = float(np.abs(points).max())  # trimesh has absolute tolerances
    with np.errstate(divide="ignore", invalid="ignore"):  # for hulls without a volume
        _, sides = trimesh.bounds.oriented_bounds(points / size)
    return size * float(max(sides))


def _parts(points: FloatArray) -> NDArray[np.int32]:
    """(N,) number of the connected part of each point."""
    tree = cKDTree(points)
    spacing = float(np.median(tree.query(points, k=_NEIGHBOUR + 1)[0][:, -1]))
    pairs = tree.query_pairs(_REACH * spacing, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points), len(points)))
    parts: NDArray[np.int32] = connected_components(links, directed=False)[1]
    return parts
