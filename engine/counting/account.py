"""The audit: for every cluster of surface points, what became of it and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .claims import members
from .cluster import Clusters
from .fruit import AuditEntry

IntArray = NDArray[np.int64]

DUST = 20
"""Clusters of fewer points than this are accounted for together."""


@dataclass(frozen=True, eq=False)
class Account:
    """entries: one a cluster; numbers: (F,) fruit id of each sphere of the clusters; compound: (F,) in order of ids,
    whether the fruit shares its cluster with another."""

    entries: list[AuditEntry]
    numbers: IntArray
    compound: NDArray[np.bool_]


def account_for(clusters: Clusters, order: IntArray, *, beyond: int = 0) -> Account:
    """Number the spheres 1… in `order` (F,) and say of every cluster why it was kept, split or dropped.

    beyond: fruit that were left out because their centres lie outside the region.
    """
    numbers = np.empty(len(order), np.int64)
    numbers[order] = np.arange(1, len(order) + 1)
    own = members(clusters.owners, len(order))
    homes = np.array([np.bincount(clusters.components[each]).argmax() for each in own], np.int64)
    sizes = np.bincount(clusters.components)
    entries = [
        _entry(clusters, int(component), int(sizes[component]), homes, numbers)
        for component in np.argsort(-sizes, kind="stable")
        if sizes[component] >= DUST or (homes == component).any()
    ]
    dust = [size for component, size in enumerate(sizes) if size < DUST and not (homes == component).any()]
    if dust:
        reason = f"{len(dust)} clusters of fewer than {DUST} points each are too small to be fruit"
        entries.append(_of_many(len(sizes), reason, int(sum(dust))))
    if beyond:
        reason = f"{beyond} fruit near the region's border have their centres outside and are not counted"
        entries.append(_of_many(len(sizes) + 1, reason, 0))
    shared = np.array([(homes == homes[sphere]).sum() > 1 for sphere in order], bool)
    return Account(entries, numbers, shared)


def _of_many(cluster: int, reason: str, points: int) -> AuditEntry:
    """What was dropped without a cluster of its own."""
    return AuditEntry(cluster=cluster, verdict="dropped", reason=reason, center=(0.0, 0.0, 0.0), points=points)


def _entry(clusters: Clusters, component: int, size: int, homes: IntArray, numbers: IntArray) -> AuditEntry:
    inside = clusters.components == component
    x, y, z = clusters.points.positions[inside].mean(axis=0).tolist()
    center = (x, y, z)
    spheres = np.flatnonzero(homes == component)
    ids = tuple(sorted(int(number) for number in numbers[spheres]))
    owners = clusters.owners[inside]
    explained = float((owners >= 0).mean())
    if len(spheres) == 0 and explained > 0.5:
        others = tuple(sorted({int(numbers[owner]) for owner in owners if owner >= 0}))
        reason = f"{explained:.0%} of its points belong to fruit {_listed(others)} of a cluster beside it"
        return AuditEntry(component, "kept", reason, center, size, others)
    if len(spheres) == 0:
        return AuditEntry(component, "dropped", clusters.refusal(component), center, size)
    fits = clusters.spheres.select(spheres)
    told = (
        f"covered from {fits.coverage.mean():.0%} of directions, {fits.shell.mean():.0%} of points on the surface, "
        f"{explained:.0%} of the cluster's points explained"
    )
    if len(spheres) == 1:
        reason = f"one sphere of diameter {2 * fits.radii[0]:.3g}, {told}"
        return AuditEntry(component, "kept", reason, center, size, ids)
    return AuditEntry(component, "split", f"{len(spheres)} touching spheres, {told}", center, size, ids)


def _listed(numbers: tuple[int, ...]) -> str:
    return ", ".join(str(number) for number in numbers)
