"""What a person decided about counted fruit, kept through later counts of the same scene.

A decision names fruit by where they are, never by number alone: a later count finds each of them where it was, and what
the person said of it holds on. The interval narrows with what has been looked at.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ...errors import CountingError
from ..fruit import NEAR

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

Action = Literal["confirm", "reject", "reopen", "merge", "split", "add", "relabel"]
Standing = Literal["", "confirmed", "rejected", "added"]
"""What a person says of a fruit: nothing yet, that it is one, that it is none, or that they made it."""

SOLID = 0.2
"""Variance of a solid ellipsoid's points along an axis, in half axes squared."""
LEAST_DOUBT = 1e-3
"""A fruit never looked at is at least so doubtful, p (1 - p)."""


@dataclass(frozen=True, eq=False)
class Spot:
    """Where a fruit is. center: (3,) in the scene's frame; axes: (3, 3), rows are its half axes, scene units."""

    id: int
    label: str
    center: FloatArray
    axes: FloatArray

    @property
    def diameter(self) -> float:
        """Of the ball of its volume, scene units."""
        return 2.0 * float(np.abs(np.linalg.det(self.axes)) ** (1.0 / 3.0))


@dataclass(frozen=True, eq=False)
class Decision:
    """One entry of the log: what was there before and what is there after.

    time: ISO 8601, UTC; reason: as the person gave it; before, after: one spot each for a relabelling, none after a
    confirmation, rejection or reopening, none before an addition.
    """

    action: Action
    time: str
    reason: str
    before: tuple[Spot, ...] = ()
    after: tuple[Spot, ...] = ()


@dataclass(frozen=True, eq=False)
class Reviewed:
    """Fruit with what persons said of them. spots and standings: (F,) one each, of which `sources` (F,) are the indices
    of the machine's fruit, -1 for what a person made; origins: (F,) the machine's fruit that each is or was made of;
    lost: decisions about fruit that are no longer found; taken: numbers that are given; last: the highest ever given;
    renumbered: {number in the log: what it is now}."""

    spots: list[Spot]
    standings: list[Standing]
    sources: list[int]
    origins: list[frozenset[int]]
    lost: list[Decision]
    taken: set[int]
    last: int
    renumbered: dict[int, int]


def about(decisions: Sequence[Decision], labels: Collection[str]) -> tuple[list[Decision], list[Decision]]:
    """The decisions on fruit of these labels, and those on others, in their order.

    A fruit that was moved from one of the labels to another one stays one of them; an added one is what it was called.
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
    """Apply decisions, in their order, to what a count found.

    Where the count by now agrees with what a person made (parts of a split, the whole of a merge, an addition), its own
    fruit stay and are confirmed. A fruit that a person made keeps its number unless the count gave it to another;
    then it gets one above all of these and above `last`.
    """
    state = Reviewed(
        spots=list(fruits),
        standings=[""] * len(fruits),
        sources=list(range(len(fruits))),
        origins=[frozenset([index]) for index in range(len(fruits))],
        lost=[],
        taken={spot.id for spot in fruits},
        last=last,
        renumbered={},
    )
    for decision in decisions:
        if not _apply(state, decision):
            state.lost.append(decision)
    return state


def _apply(state: Reviewed, decision: Decision) -> bool:
    """Apply one decision; False where its fruit are not found."""
    if decision.action in {"merge", "split", "add"}:
        return _make(state, decision)
    found = _found(state, decision.before)
    if decision.action == "relabel":
        for index in found:
            state.spots[index] = replace(state.spots[index], label=decision.after[0].label)
    standing: Standing = {"reject": "rejected", "reopen": ""}.get(decision.action, "confirmed")  # type: ignore[assignment]
    _stand(state, found, standing)
    return bool(found)


def _make(state: Reviewed, decision: Decision) -> bool:
    """Put what a person made in the place of what was there, or confirm it where the count found it by itself."""
    before, after = _found(state, decision.before), _found(state, decision.after)
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


def _found(state: Reviewed, spots: Sequence[Spot]) -> list[int]:
    """Indices of the fruit that these spots are, one to one, nearest first."""
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


def corrected_interval(
    count: int,
    interval: tuple[int, int],
    probabilities: FloatArray,
    reviewed: NDArray[np.bool_],
    rejected: int,
    after: int,
) -> tuple[int, int]:
    """90 % interval of the visible fruit after a review.

    The machine counted `count` fruit with probabilities chances (F,) and an interval; the person has looked at
    `reviewed` (F,) of them, rejected some, and ends with `after` fruit. Below, only fruit nobody looked at may be
    false: the distance to the lower end shrinks as the square root of their share of the doubt, Σ p (1 - p). Above, the
    machine may have missed fruit: that distance shrinks by those that the person made. The count after the review lies
    within; where nothing was looked at the interval is the machine's.
    """
    doubt = np.maximum(probabilities * (1.0 - probabilities), LEAST_DOUBT)
    share = float(np.sqrt(doubt[~reviewed].sum() / doubt.sum())) if len(doubt) else 1.0
    below = (count - interval[0]) * share
    above = max(interval[1] - count - max(after - (count - rejected), 0), 0)
    return max(int(np.ceil(after - below - 0.5)), 0), after + above


def merged(spots: Sequence[Spot], number: int) -> Spot:
    """One fruit for several: the solid ellipsoid with the centre and second moments of theirs together.

    Raises:
        CountingError: none of them has a size.
    """
    volumes = np.array([spot.diameter**3 for spot in spots])
    if not volumes.sum() > 0.0:
        raise CountingError("The fruit have no size. Scale one of them up first")
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


def split(
    spot: Spot, parts: int, points: FloatArray, numbers: Sequence[int], seed: int = 0
) -> tuple[list[Spot], IntArray]:
    """`parts` balls for one fruit, of its volume together, and the part (P,) that each of its points (P, 3) is of.

    The points, places of its Gaussians, are clustered; a part stands as far from the middle as its points tell. With
    too few points the parts lie in a row along the longest axis.

    Raises:
        CountingError: fewer than two parts are asked for, or more than twelve.
    """
    if not 2 <= parts <= 12:
        raise CountingError(f"A fruit is split into 2 to 12 parts, not {parts}")
    radius = spot.diameter / 2.0 / parts ** (1.0 / 3.0)
    if len(points) >= 4 * parts:
        from sklearn.cluster import KMeans  # here, because a panel asks for intervals where it may not be installed

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
    """A round fruit that a person pointed at."""
    return Spot(number, label, np.asarray(center, np.float64), 0.5 * diameter * np.eye(3))
