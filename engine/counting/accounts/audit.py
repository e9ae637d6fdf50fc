"""The audit: for every cluster of surface points, what it became and why."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..evidence.claims import commonest, members
from ..evidence.cluster import Clusters
from ..fruit import AuditEntry, Verdict

IntArray = NDArray[np.int64]

DUST = 20
"""Smaller clusters are summarised in one entry."""


@dataclass(frozen=True, eq=False)
class Account:
    """entries: one per cluster; compound: (F,) whether a sphere shares its cluster with another."""

    entries: list[AuditEntry]
    compound: NDArray[np.bool_]


def account_for(clusters: Clusters, numbers: IntArray, *, beyond: int = 0) -> Account:
    """Give the reason why each cluster was kept, split, merged or dropped.

    numbers: (F,) the fruit id of each sphere; beyond: number of fruit left out because their centres lie outside the
    region.
    """
    own = members(clusters.owners, len(numbers))
    homes = np.array([commonest(clusters.components[each]) if len(each) else -1 for each in own], np.int64)
    sizes = np.bincount(clusters.components)
    pointless = np.flatnonzero(homes < 0)
    points, spheres = members(clusters.components, len(sizes)), members(homes, len(sizes))
    kept = (sizes >= DUST) | (np.bincount(homes[homes >= 0], minlength=len(sizes)) > 0)
    entries = [
        _make_entry(clusters, component, points[component], spheres[component], numbers)
        for component in np.argsort(-sizes, kind="stable").tolist()
        if kept[component]
    ]
    entries += [
        _make_photo_entry(clusters, len(sizes) + place, index, numbers)
        for place, index in enumerate(pointless.tolist())
    ]
    dust = sizes[~kept]
    if len(dust):
        reason = f"{len(dust)} clusters of fewer than {DUST} points each are too small to be fruit"
        entries.append(_make_dropped_entry(len(sizes) + len(pointless), reason, int(dust.sum())))
    if beyond:
        reason = f"{beyond} fruit near the region's border have their centres outside and are not counted"
        entries.append(_make_dropped_entry(len(sizes) + len(pointless) + 1, reason, 0))
    return Account(entries, np.array([home >= 0 and len(spheres[home]) > 1 for home in homes], bool))


def _make_photo_entry(clusters: Clusters, cluster: int, sphere: int, numbers: IntArray) -> AuditEntry:
    """Make the entry of a fruit that photos show and no surface of Gaussians."""
    x, y, z = clusters.spheres.centers[sphere].tolist()
    reason = "seen in the photos only: no surface of the Gaussians is on it"
    diameter = float(2.0 * clusters.spheres.radii[sphere])
    return AuditEntry(cluster, "kept", reason, (x, y, z), 0, (int(numbers[sphere]),), diameter)


def _make_dropped_entry(cluster: int, reason: str, points: int) -> AuditEntry:
    """Make the entry for points that were dropped without a cluster of their own."""
    return AuditEntry(cluster=cluster, verdict="dropped", reason=reason, center=(0.0, 0.0, 0.0), points=points)


def _make_entry(
    clusters: Clusters, component: int, inside: IntArray, spheres: IntArray, numbers: IntArray
) -> AuditEntry:
    """Say what one cluster became; inside: its points; spheres: those that own most of their points in it."""
    x, y, z = clusters.points.positions[inside].mean(axis=0).tolist()
    center, size = (x, y, z), len(inside)
    ids = tuple(sorted(int(number) for number in numbers[spheres]))
    owners = clusters.owners[inside]
    explained = float((owners >= 0).mean())
    if len(spheres) == 0 and explained > 0.5:
        others = tuple(sorted({int(numbers[owner]) for owner in owners if owner >= 0}))
        reason = f"{explained:.0%} of its points belong to fruit {_join_numbers(others)} of a neighbouring cluster"
        return AuditEntry(component, "merged", reason, center, size, others)
    if len(spheres) == 0:
        return AuditEntry(component, "dropped", clusters.refusal(component), center, size)
    verdict: Verdict = "split" if len(spheres) > 1 else "kept"
    diameter = float(2.0 * clusters.spheres.radii[spheres].mean())
    if component in clusters.findings:
        return AuditEntry(component, verdict, clusters.findings[component], center, size, ids, diameter)
    fits = clusters.spheres.select(spheres)
    text = (
        f"covered from {fits.coverage.mean():.0%} of directions, {fits.shell.mean():.0%} of points on the surface, "
        f"{explained:.0%} of the cluster's points explained"
    )
    if len(spheres) == 1:
        return AuditEntry(component, verdict, f"one sphere, {text}", center, size, ids, diameter)
    return AuditEntry(component, verdict, f"{len(spheres)} touching spheres, {text}", center, size, ids, diameter)


def _join_numbers(numbers: tuple[int, ...]) -> str:
    return ", ".join(str(number) for number in numbers)
