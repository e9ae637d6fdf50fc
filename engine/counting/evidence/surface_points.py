"""Surface points of the selected Gaussians (paper eq. 12), each with its normal and the direction it was seen from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ...splatting.gaussians import Gaussians
from ..geometry.cells import Cells
from ..geometry.random_streams import RandomStreams, even_turns
from .surface_point_kernels import cover
from .visibility import Visibility

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SURFACE = 2.0
"""Standard deviations from the mean at which an opaque Gaussian appears to end."""
FACING = 0.1
"""Least cosine between the normal of a surface point and the mean direction to the cameras that show its Gaussian."""
LEAST_OPACITY = 0.2
SPARE = 3
"""Surface points tried per point needed: about a third are on the visible side and not covered."""
LARGEST_SCALE = 0.5
"""Largest standard deviation, in mean fruit diameters, of a Gaussian that gives points."""
ENOUGH = 50.0
"""Points within a quarter of a diameter that represent a fruit well."""
BLOCK = 2_000_000
"""Points tried at once, which bounds the memory."""
SURVEY, SURVEYED = 60_000, 5_000
"""Points of a first sample, and how many of them are used to measure the density."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """P points sampled from selected Gaussians.

    positions: (P, 3) scene units; normals: (P, 3) unit, out of the surface towards the cameras that show it; gaussians:
    (P,) index of the Gaussian each came from; probabilities: (P,); directions: (P, 3) mean direction towards the seeing
    cameras; turns: (P,) in [0, 1); the points below a share are an even sample of all.
    """

    positions: FloatArray
    normals: FloatArray
    gaussians: IntArray
    probabilities: FloatArray
    directions: FloatArray
    turns: FloatArray

    def __len__(self) -> int:
        return len(self.positions)

    def thin(self, share: float) -> SurfacePoints:
        """Take an even sample of the points, which does not depend on how the scene was moved."""
        part = self.select(self.turns < share)
        return replace(part, turns=part.turns / share)

    @staticmethod
    def join(parts: Sequence[SurfacePoints]) -> SurfacePoints:
        """The points of all parts, one after the other."""
        names = [each.name for each in fields(SurfacePoints)]
        return SurfacePoints(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def select(self, index: NDArray) -> SurfacePoints:
        """The points at `index` (bool mask (P,) or integer indices)."""
        return SurfacePoints(**{each.name: getattr(self, each.name)[index] for each in fields(self)})


def sample_volume(
    gaussians: Gaussians,
    probability: FloatArray,
    visibility: Visibility,
    selected: IntArray,
    *,
    budget: int,
    seed: int,
    largest: float = np.inf,
) -> SurfacePoints:
    """Sample `budget` points inside the selected Gaussians, N_i ∝ det(Σ_i)^½ · α_i (paper eq. 12).

    Only Gaussians whose largest standard deviation is at most `largest` scene units give points: a few large blurred
    ones would otherwise use the whole budget. The normal of a point is the flat axis of its Gaussian, turned to the
    cameras that show it.
    """
    chosen = _Chosen.of(gaussians, probability, visibility, selected, largest)
    logs = np.log(chosen.scales).sum(axis=1)
    owner = np.repeat(
        np.arange(len(chosen)), spread_out(np.exp(logs - logs.max(initial=0.0)) * chosen.opacities, budget)
    )
    own = np.random.default_rng(seed).standard_normal((len(owner), 3)).clip(-2.0, 2.0)
    positions = chosen.means[owner] + np.einsum("pij,pj->pi", chosen.axes[owner], own * chosen.scales[owner])
    flat = np.take_along_axis(chosen.axes, chosen.scales.argmin(axis=1)[:, None, None], axis=2)[:, :, 0]
    normals = turn_towards(flat, chosen.directions)[owner]
    return chosen.points(positions, normals, owner, even_turns(len(owner)))


def sample_surface(
    gaussians: Gaussians,
    probability: FloatArray,
    visibility: Visibility,
    selected: IntArray,
    *,
    budget: int,
    seed: int,
    largest: float = np.inf,
) -> SurfacePoints:
    """Sample about `budget` points of the surface that the selected Gaussians represent together.

    Trained Gaussians lie below the surface they represent and large ones fill the volume, so points spread through the
    volume make fruit a fifth too small. These points lie on the ellipsoids of SURFACE standard deviations, on the side
    of the cameras that show them and outside other Gaussians; the normal is that of the ellipsoid. N_i ∝ the pixels
    that Gaussian i covers in a view that shows it: fruit that few views show have as many points as others. Gaussians
    wider than `largest` give none. Where the points of a Gaussian lie depends only on its position in the cameras'
    frame.
    """
    chosen = _Chosen.of(gaussians, probability, visibility, selected, largest)
    return _surface(chosen, chosen.streams(visibility.frame, seed), budget)


def _surface(chosen: _Chosen, streams: RandomStreams, budget: int) -> SurfacePoints:
    pixels = chosen.weights / np.maximum(chosen.views, 1) * (chosen.opacities >= LEAST_OPACITY)
    owner = np.repeat(np.arange(len(chosen)), share_out(pixels, SPARE * budget))
    numbers = streams.number(owner)
    blocks = [slice(start, start + BLOCK) for start in range(0, max(len(owner), 1), BLOCK)]
    return SurfacePoints.join([_surface_of(chosen, streams, owner[block], numbers[block]) for block in blocks])


def _surface_of(chosen: _Chosen, streams: RandomStreams, owner: IntArray, numbers: IntArray) -> SurfacePoints:
    """The visible ones of these points; owner: the Gaussian of each, numbers: its number within that Gaussian's
    position."""
    own, turns = streams.directions(owner, numbers), streams.turns(owner, numbers)
    axes, scales = chosen.axes[owner], chosen.scales[owner]
    normals = np.einsum("pij,pj->pi", axes, own / scales)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faced = np.einsum("pi,pi->p", normals, chosen.directions[owner]) > FACING
    owner, normals, turns = owner[faced], normals[faced], turns[faced]
    positions = chosen.means[owner] + SURFACE * np.einsum("pij,pj->pi", axes[faced], (own * scales)[faced])
    free = ~find_covered(positions, chosen)
    return chosen.points(positions[free], normals[free], owner[free], turns[free])


def sample_enough(
    gaussians: Gaussians,
    probability: FloatArray,
    visibility: Visibility,
    selected: IntArray,
    *,
    diameter: float,
    most: int,
    seed: int,
) -> SurfacePoints:
    """As many surface points as fruit of `diameter` scene units need to be separated, and at most about `most`.

    A first sample measures how densely its points lie on the fruit; density grows with the budget.
    """
    chosen = _Chosen.of(gaussians, probability, visibility, selected, LARGEST_SCALE * diameter)
    streams, budget = chosen.streams(visibility.frame, seed), min(SURVEY, most)
    points = _surface(chosen, streams, budget)
    if len(points) == 0:
        return points
    return _surface(chosen, streams, min(most, int(budget * ENOUGH / max(density(points, diameter), 1.0))))


def density(points: SurfacePoints, diameter: float) -> float:
    """Median over the points of the number of points within a quarter of a diameter, itself included."""
    cells = Cells.of(points.positions, 0.3 * diameter)
    asked = points.thin(min(1.0, SURVEYED / len(points))).positions
    return float(np.median(cells.numbers(asked, np.full(len(asked), 0.25 * diameter))))


@dataclass(frozen=True, eq=False)
class _Chosen:
    """The G Gaussians that give points, in an order that does not depend on shuffling or rigid motion."""

    index: IntArray
    means: FloatArray
    scales: FloatArray
    axes: FloatArray
    opacities: FloatArray
    probabilities: FloatArray
    weights: FloatArray
    views: IntArray
    directions: FloatArray

    def __len__(self) -> int:
        return len(self.index)

    @staticmethod
    def of(
        gaussians: Gaussians, probability: FloatArray, visibility: Visibility, selected: IntArray, largest: float
    ) -> _Chosen:
        scales = _array(gaussians.scales)
        index = selected[scales[selected].max(axis=1, initial=0.0) <= largest]
        index = index[canonical_order(gaussians, probability, index)]
        part = gaussians.select(torch.from_numpy(index))
        return _Chosen(
            index=index,
            means=_array(part.means),
            scales=np.maximum(scales[index], 1e-12),
            axes=_array(part.rotations),
            opacities=_array(part.opacities),
            probabilities=probability[index],
            weights=visibility.weights[index],
            views=visibility.views[index],
            directions=visibility.directions[index],
        )

    def streams(self, frame: FloatArray, seed: int) -> RandomStreams:
        """The random streams of the Gaussians in the cameras' frame (3, 4)."""
        return RandomStreams.draw(self.means @ frame[:, :3].T + frame[:, 3], seed)

    def points(self, positions: FloatArray, normals: FloatArray, owner: IntArray, turns: FloatArray) -> SurfacePoints:
        """Points whose Gaussians are `owner` (P,), counted in this order."""
        probabilities, directions = self.probabilities[owner], self.directions[owner]
        return SurfacePoints(positions, normals, self.index[owner], probabilities, directions, turns)


def find_covered(positions: FloatArray, chosen: _Chosen) -> NDArray[np.bool_]:
    """Find whether one of the Gaussians alone is more than half opaque at each position (P,)."""
    inside = np.zeros(len(positions), bool)
    if len(positions) == 0:
        return inside
    squares = 2.0 * np.log(np.maximum(chosen.opacities / 0.5, 1.0))
    reaches = np.sqrt(squares) * chosen.scales.max(axis=1)
    cells = Cells.of(positions, max(float(reaches.mean()), 1e-12))
    cover(cells.table, chosen.means, chosen.axes, chosen.scales, squares, inside)
    inside[cells.index] = inside.copy()
    return inside


def share_out(shares: FloatArray, budget: int) -> IntArray:
    """Whole numbers (N,) that sum to `budget`, proportional to non-negative `shares` (N,), by largest remainder."""
    if len(shares) == 0:
        return np.zeros(0, np.int64)
    total = shares.sum()
    exact = shares * (budget / total) if total > 0 else np.full(len(shares), budget / len(shares))
    counts = np.floor(exact).astype(np.int64)
    rest = budget - int(counts.sum())
    counts[np.argsort(counts - exact, kind="stable")[:rest]] += 1
    return counts


def spread_out(shares: FloatArray, budget: int) -> IntArray:
    """Whole numbers (N,) that sum to `budget`; over any run of them within 1 of the non-negative `shares` (N,).

    If N is above the budget, largest remainders would give one point to each of the largest shares and none to the
    others: fruit of small Gaussians would disappear.
    """
    total = np.cumsum(shares)
    if len(shares) == 0 or total[-1] <= 0.0:
        return share_out(shares, budget)
    ends = np.floor(total * (budget / total[-1]) + 0.5).astype(np.int64)
    ends[-1] = budget
    return np.diff(ends, prepend=0)


def canonical_order(gaussians: Gaussians, probability: FloatArray, selected: IntArray) -> IntArray:
    """Order of the selected Gaussians by opacity, colour, probability and, if these are equal, position."""
    part = gaussians.select(torch.from_numpy(selected))
    return np.lexsort(
        (*_array(part.means).T, probability[selected], *_array(part.sh[:, 0]).T, _array(part.opacity_logits))
    )


def _array(tensor: torch.Tensor) -> FloatArray:
    return tensor.detach().double().cpu().numpy()


def turn_towards(normals: FloatArray, directions: FloatArray) -> FloatArray:
    """The normals (N, 3), each flipped where it points away from its direction (N, 3)."""
    away = np.einsum("ij,ij->i", normals, directions) < 0.0
    return np.where(away[:, None], -normals, normals)
