"""Parts of a cluster of points, each with an aligned template."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, ward
from scipy.spatial import cKDTree

from ..evidence.claims import members
from ..geometry.alpha_shape import alpha_shape_volume
from .registration import Registration, register
from .template_shape import ALPHA, Template

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

MOST_JOINED = 2000
"""Points, evenly thinned, of the tree of parts: its time grows with their square."""
VOLUME_POINTS = 4000
"""Points, evenly thinned, of an alpha shape."""
SMALLEST = 8
"""Points of the smallest part that a template is aligned to."""


@dataclass(frozen=True, eq=False)
class Part:
    """index: (M,) points that one template was aligned to; small: a fruit of which little is visible, or a small
    one."""

    index: IntArray
    fit: Registration
    small: bool = False


@dataclass(frozen=True, eq=False)
class Cloud:
    """The points that templates are aligned to. Lengths are in fruit diameters.

    positions: (P, 3); origins: (P, 3) the centre of its fruit according to each point, the mean of which is a first
    estimate.
    """

    positions: FloatArray
    origins: FloatArray
    template: Template

    def volume(self, index: IntArray) -> float:
        """The volume of the alpha shape of the points at `index`, in template volumes."""
        return alpha_shape_volume(self.positions[thin(index, VOLUME_POINTS)], ALPHA) / self.template.volume

    def part(self, index: IntArray, *, small: bool = False) -> Part:
        """The points at `index` with the aligned template."""
        return Part(index, register(self.positions[index], self.template, self.origins[index].mean(axis=0)), small)


def thin(index: IntArray, most: int) -> IntArray:
    """Take at most so many of the numbers in `index`, spread evenly over it."""
    return index[np.linspace(0, len(index) - 1, min(len(index), most)).astype(np.int64)]


def hausdorff(parts: Sequence[Part]) -> float:
    """Mean Hausdorff distance between parts and their templates, in fruit diameters."""
    return float(np.mean([part.fit.hausdorff for part in parts]))


def best_split(cloud: Cloud, index: IntArray, most: int) -> list[Part]:
    """The points at `index` as one part, or as the 2 to `most` parts with the least mean Hausdorff distance."""
    best = [cloud.part(index)]
    fitted = {index.tobytes(): best[0]}
    for groups in cuts(cloud.positions, index, most):
        parts = [fitted.get(group.tobytes()) or cloud.part(group) for group in groups]
        fitted = {part.index.tobytes(): part for part in parts}
        if hausdorff(parts) < hausdorff(best):
            best = parts
    return best


def cuts(positions: FloatArray, index: IntArray, most: int) -> Iterator[list[IntArray]]:
    """The points at `index` of positions (P, 3) in 2, 3, … `most` groups, without those of too few points.

    All are cuts of one tree of agglomerative clustering (Ward 1963), which has no random start, unlike k-means; each
    splits one group of the one before.
    """
    few = thin(np.arange(len(index)), MOST_JOINED)
    if len(few) < 2 * SMALLEST:
        return
    tree, nearest = ward(positions[index[few]]), cKDTree(positions[index[few]]).query(positions[index])[1]
    for count in range(2, min(most, len(few) // SMALLEST) + 1):
        labels = fcluster(tree, count, criterion="maxclust")[nearest]
        groups = [index[own] for own in members(labels - 1, count) if len(own) >= SMALLEST]
        if groups:
            yield groups
