"""Decisions of the user about counted fruit, which stay valid in later counts of the same scene.

A decision identifies fruit by their position, never by id alone: a later count finds each fruit at its position, and
the decision applies to it again. The interval narrows with the number of reviewed fruit.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import CountingError
from ..fruit import NEAR
from .plausible import check_merge, check_size

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

Action = Literal["confirm", "reject", "reopen", "merge", "split", "add", "relabel"]
Standing = Literal["", "confirmed", "rejected", "added"]
"""The state of a fruit in the review: not reviewed, confirmed, rejected, or made by the user."""

SOLID = 0.2
"""Variance of the points of a solid ellipsoid along an axis, in half axes squared."""
LEAST_UNCERTAINTY = 1e-3
"""Least uncertainty p (1 - p) of a fruit that is not reviewed."""


@dataclass(frozen=True, eq=False)
class Spot:
    """Position of a fruit. center: (3,) in the scene frame; axes: (3, 3), rows are its half axes, scene units."""

    id: int
    label: str
    center: FloatArray
    axes: FloatArray

    @property
    def diameter(self) -> float:
        """Diameter of the sphere of equal volume, scene units."""
        return 2.0 * float(np.abs(np.linalg.det(self.axes)) ** (1.0 / 3.0))


@dataclass(frozen=True, eq=False)
class Decision:
    """One entry of the log: the fruit before and after the decision.

    time: ISO 8601, UTC; reason: as the user entered it; before, after: one spot each for a relabelling, none after a
    confirmation, rejection or reopening, none before an addition.
    """

    action: Action
    time: str
    reason: str
    before: tuple[Spot, ...] = ()
    after: tuple[Spot, ...] = ()


@dataclass(frozen=True, eq=False)
class Reviewed:
    """Fruit with the decisions about them. spots and standings: (F,); sources: (F,) index of the counted fruit, -1 for
    one that the user made; origins: (F,) the counted fruit that each is or was made from; lost: decisions about fruit
    that were not found; refused: why merges were not made again, which joined fruit too far apart to be one; taken: ids
    in use; last: the highest id ever used; renumbered: {id in the log: id now}."""

    spots: list[Spot]
    standings: list[Standing]
    sources: list[int]
    origins: list[frozenset[int]]
    lost: list[Decision]
    refused: list[str]
    taken: set[int]
    last: int
    renumbered: dict[int, int]


def split_by_label(decisions: Sequence[Decision], labels: Collection[str]) -> tuple[list[Decision], list[Decision]]:
    """Split the decisions into those about fruit of these labels and those about others, in order.

    A fruit that was moved from one of the labels to another still belongs to them; an added fruit belongs to its label.
    """
    known, own, others = set(labels), [], []
    for decision in decisions:
        spots, asked = (decision.after, labels) if decision.action == "add" else (decision.before, known)
        if not any(spot.label in asked for spot in spots):
            others.append(decision)
            continue
        own.append(decision)
        if decision.action == "relabel":
            known |= {spot.label for spot in decision.after}
    return own, others


def replay(decisions: Sequence[Decision], fruits: Sequence[Spot], last: int = 0) -> Reviewed:
    """Apply decisions, in order, to a count.

    If the count now agrees with a fruit that the user made (parts of a split, the result of a merge, an addition), the
    counted fruit stay and are confirmed. A fruit that the user made keeps its id unless the count gave it to another;
    then it gets one above all ids in use and above `last`. A merge of fruit that cannot be one is not made again.
    """
    state = Reviewed(
        spots=list(fruits),
        standings=[""] * len(fruits),
        sources=list(range(len(fruits))),
        origins=[frozenset([index]) for index in range(len(fruits))],
        lost=[],
        refused=[],
        taken={spot.id for spot in fruits},
        last=last,
        renumbered={},
    )
    usual = float(np.median([spot.diameter for spot in fruits])) if fruits else 0.0
    for decision in decisions:
        try:
            if decision.action == "merge":
                _check_parts(decision.before, usual)
        except CountingError as error:
            state.refused.append(str(error))
            continue
        if not _apply(state, decision):
            state.lost.append(decision)
    return state


def _apply(state: Reviewed, decision: Decision) -> bool:
    """Apply one decision; False if its fruit are not found."""
    if decision.action in {"merge", "split", "add"}:
        return _make(state, decision)
    found = _find_fruit(state, decision.before)
    if decision.action == "relabel":
        for index in found:
            state.spots[index] = replace(state.spots[index], label=decision.after[0].label)
    standing: Standing = {"reject": "rejected", "reopen": ""}.get(decision.action, "confirmed")  # type: ignore[assignment]
    _stand(state, found, standing)
    return bool(found)


def _make(state: Reviewed, decision: Decision) -> bool:
    """Replace fruit by what the user made, or confirm them if the count found the same."""
    before, after = _find_fruit(state, decision.before), _find_fruit(state, decision.after)
    still_apart = decision.action == "merge" and len(before) > 1
    if len(after) == len(decision.after) and not still_apart:
        _stand(state, after, "confirmed")
        return True
    if decision.action != "add" and not before:
        return False
    origins = frozenset().union(*(state.origins[index] for index in before))
    _remove(state, before)
    for spot in decision.after:
        _add(state, spot, origins)
    return True


def _find_fruit(state: Reviewed, spots: Sequence[Spot]) -> list[int]:
    """Find the indices of the fruit at these spots, one to one, nearest first."""
    if not state.spots:
        return []
    centers = np.stack([spot.center for spot in state.spots])
    sizes = np.array([spot.diameter for spot in state.spots])
    pairs = []
    for place, spot in enumerate(spots):
        distances = np.linalg.norm(centers - spot.center, axis=1)
        near = np.flatnonzero(distances <= NEAR * np.maximum(sizes, spot.diameter))
        pairs += [(float(distances[index]), place, int(index)) for index in near]
    taken: dict[int, int] = {}
    for _, place, index in sorted(pairs):
        if place not in taken and index not in taken.values():
            taken[place] = index
    return [taken[place] for place in sorted(taken)]


def _stand(state: Reviewed, indices: Sequence[int], standing: Standing) -> None:
    for index in indices:
        made = state.sources[index] < 0 and standing in {"", "confirmed"}
        state.standings[index] = "added" if made else standing


def _remove(state: Reviewed, indices: Sequence[int]) -> None:
    for index in sorted(indices, reverse=True):
        for rows in (state.spots, state.standings, state.sources, state.origins):
            del rows[index]  # type: ignore[attr-defined]


def _add(state: Reviewed, spot: Spot, origins: frozenset[int]) -> None:
    if spot.id in state.taken:
        number = max(state.last, *state.taken) + 1
        state.renumbered[spot.id] = number
        spot = replace(spot, id=number)
    state.taken.add(spot.id)
    state.spots.append(spot)
    state.standings.append("added")
    state.sources.append(-1)
    state.origins.append(origins)


def correct_interval(
    count: int,
    interval: tuple[int, int],
    probabilities: FloatArray,
    reviewed: NDArray[np.bool_],
    rejected: int,
    after: int,
) -> tuple[int, int]:
    """Return the 90 % interval of the visible fruit after a review.

    The count had `count` fruit with `probabilities` (F,) and an interval. The user reviewed `reviewed` (F,) of them,
    rejected some, and ends with `after` fruit. Below the count, only fruit that were not reviewed may be false: the
    distance to the lower end shrinks with the square root of their share of the uncertainty Σ p (1 - p). Above it, the
    count may have missed fruit: that distance shrinks by the fruit that the user made. The reviewed count lies in the
    interval; without any review the interval does not change.
    """
    uncertainty = np.maximum(probabilities * (1.0 - probabilities), LEAST_UNCERTAINTY)
    share = float(np.sqrt(uncertainty[~reviewed].sum() / uncertainty.sum())) if len(uncertainty) else 1.0
    below = (count - interval[0]) * share
    above = max(interval[1] - count - max(after - (count - rejected), 0), 0)
    return max(int(np.ceil(after - below - 0.5)), 0), after + above


def merge(spots: Sequence[Spot], number: int, usual: float = 0.0) -> Spot:
    """Merge several fruit into one: the solid ellipsoid with their common centre and second moments. usual: the usual
    diameter of fruit, scene units; 0 if unknown.

    Raises:
        CountingError: none of them has a size, or they are too far apart to be one fruit.
    """
    volumes = np.array([spot.diameter**3 for spot in spots])
    if not volumes.sum() > 0.0:
        raise CountingError("The fruit have no size. Scale one of them up first")
    _check_parts(spots, usual)
    weights = volumes / volumes.sum()
    center = weights @ np.stack([spot.center for spot in spots])
    spread = np.zeros((3, 3))
    for weight, spot in zip(weights, spots, strict=True):
        away = (spot.center - center)[:, None]
        spread += weight * (SOLID * spot.axes.T @ spot.axes + away @ away.T)
    variances, directions = np.linalg.eigh(spread)
    axes = np.sqrt(np.maximum(variances, 0.0) / SOLID)[::-1, None] * directions.T[::-1]
    axes[2] *= np.sign(np.linalg.det(axes)) or 1.0
    return Spot(number, spots[0].label, center, axes)


def _check_parts(spots: Sequence[Spot], usual: float) -> None:
    lengths = [2.0 * np.linalg.norm(spot.axes, axis=1).max() for spot in spots]
    centers = np.array([spot.center for spot in spots]).reshape(-1, 3)
    check_merge([spot.id for spot in spots], centers, np.array(lengths), usual)


def split(
    spot: Spot, parts: int, points: FloatArray, numbers: Sequence[int], seed: int = 0, usual: float = 0.0
) -> tuple[list[Spot], IntArray]:
    """Split a fruit into `parts` spheres of its total volume, and assign each of its points (P, 3) to a part (P,).

    The points, positions of its Gaussians, are clustered; the distance of the parts from the centre follows from the
    points. With too few points the parts lie in a row along the longest axis. usual: the usual diameter of fruit, scene
    units; 0 if unknown.

    Raises:
        CountingError: fewer than two parts are asked for, or more than twelve, or parts too small for fruit.
    """
    if not 2 <= parts <= 12:
        raise CountingError(f"A fruit is split into 2 to 12 parts, not {parts}")
    radius = spot.diameter / 2.0 / parts ** (1.0 / 3.0)
    check_size(f"{parts} parts", 2.0 * radius, usual)
    if len(points) >= 4 * parts:
        from sklearn.cluster import KMeans  # here, because a panel that asks for intervals must work without it

        found = KMeans(parts, n_init=10, random_state=seed).fit(points)
        centers, owners = found.cluster_centers_, found.labels_.astype(np.int64)
        order = np.argsort(-np.bincount(owners, minlength=parts), kind="stable")
        centers, owners = centers[order], np.argsort(order)[owners]
    else:
        steps = (2.0 * np.arange(parts) + 1.0) / parts - 1.0
        centers = spot.center + steps[:, None] * spot.axes[0]
        owners = np.linalg.norm(points.reshape(-1, 1, 3) - centers, axis=2).argmin(axis=1)
    balls = [
        Spot(number, spot.label, center, radius * np.eye(3)) for number, center in zip(numbers, centers, strict=True)
    ]
    return balls, owners


def ball(number: int, label: str, center: FloatArray, diameter: float) -> Spot:
    """A round fruit at a point that the user clicked."""
    return Spot(number, label, np.asarray(center, np.float64), 0.5 * diameter * np.eye(3))
